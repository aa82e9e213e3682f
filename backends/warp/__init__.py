"""What the engines that run on Warp share."""

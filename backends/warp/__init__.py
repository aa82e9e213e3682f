"""The common parts of the engines on Warp."""

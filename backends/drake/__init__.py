"""Drake on the CPU (extra ``[drake]``)."""

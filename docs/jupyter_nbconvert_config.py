"""Run the notebooks over encrypted sockets, because the kernel warns of others."""

get_config().KernelManager.transport_encryption = "required"  # type: ignore[name-defined]  # noqa: F821

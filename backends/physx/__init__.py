"""NVIDIA PhysX on the CPU by ovphysx (extra ``[physx]``)."""

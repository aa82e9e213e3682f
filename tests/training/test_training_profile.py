"""Whose time a profile says it is: a trace with a known answer."""

import training_profile
from training_profile import shares

ANNOTATION, CALL, KERNEL = "user_annotation", "cuda_runtime", "kernel"


def event(category, name, ts, dur, correlation=None):
    return {"cat": category, "name": name, "ts": ts, "dur": dur, "args": {"correlation": correlation}}


def test_kernels_belong_to_the_part_that_launched_them():
    found = shares(
        [
            event(ANNOTATION, "physics", 0, 10),
            event(ANNOTATION, "acting", 20, 10),
            event(ANNOTATION, "somebody's own", 0, 100),
            event(CALL, "cudaGraphLaunch", 1, 1, 1),
            event(CALL, "cudaLaunchKernel", 21, 1, 2),
            event(CALL, "cudaStreamSynchronize", 25, 4, 3),
            event(CALL, "cudaLaunchKernel", 40, 1, 4),
            event(KERNEL, "solve_abcdef12_cuda_kernel_forward", 2, 6, 1),
            event(KERNEL, "solve_12345678_cuda_kernel_forward", 9, 3, 1),
            event(KERNEL, "void cutlass::Kernel2<cutlass_80_tensorop_s1688gemm_128x128_16x5_tn_align1>(x)", 22, 4, 2),
            event(KERNEL, "copy", 24, 6, 4),  # beside the one before
        ]
    )
    physics, acting, rest = found["physics"], found["acting"], found[training_profile.ELSE]
    assert (physics.microseconds, physics.idle, physics.kernels, physics.waits) == (9, 1, 2, 0)
    assert physics.names == {"solve": 9}
    assert (acting.microseconds, acting.idle, acting.kernels, acting.waits) == (4, 10, 1, 1)
    assert acting.names == {"cutlass_80_tensorop_s1688gemm_128x128_16x5_tn_align1": 4}
    assert (rest.microseconds, rest.idle, rest.kernels) == (6, 0, 1)


def test_without_kernels_parts_have_their_own_time():
    found = shares([event(ANNOTATION, "physics", 0, 10), event(ANNOTATION, "physics", 20, 5)])
    assert (found["physics"].microseconds, found["physics"].kernels) == (15, 2)

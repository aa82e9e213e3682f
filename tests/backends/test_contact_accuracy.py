"""What contacts do to a walking robot, as ``benchmarks/contact_accuracy.py`` measures it."""

import contact_accuracy as accuracy
import pytest


@pytest.mark.slow
def test_trainings_physics_is_near_the_converged_one_and_the_old_one_far():
    def force(setting):
        found = accuracy.walk("mujoco", "flat", accuracy.options(setting), worlds=4, seconds=1.5)
        return accuracy.np.quantile(found.force, 0.999), found

    converged, found = force("pyramidal,1,converged")
    assert found.fell == found.diverged == 0 and 0.0 < accuracy.np.median(found.depth) < 0.02
    assert force("pyramidal,1,6")[0] == pytest.approx(converged, rel=0.1)
    assert force("pyramidal,100,6")[0] > 1.5 * converged

"""Options of training runs that take a second."""

SMALL = (
    "training.algorithm.minibatches=1",
    "training.algorithm.epochs=1",
    "training.run.steps_per_iteration=4",
    "training.network.actor_hidden=8",
    "training.network.critic_hidden=8",
    "training.network.teacher_hidden=8",
    "training.network.student_hidden=8",
)
FAKE = ("--backend", "fake", "--device", "cpu", "--num-envs", 8, "--no-score", "--no-film")

"""Name the packages: the root of the repository is the package ``gaitgauge``, and every folder with code below it a subpackage."""

from setuptools import find_packages, setup

NOT_INSTALLED = ["benchmarks*", "build*", "docs*", "examples*", "tests*"]

setup(
    packages=["gaitgauge", *(f"gaitgauge.{name}" for name in find_packages(".", exclude=NOT_INSTALLED))],
    package_dir={"gaitgauge": "."},
)

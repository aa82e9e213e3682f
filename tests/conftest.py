"""What all tests share."""

import gc
import io
import json
import os
import pickle
import random
import signal
import sys
from collections.abc import Callable, Iterator
from copy import copy, deepcopy
from functools import cache
from importlib.metadata import EntryPoint, distributions
from pathlib import Path
from typing import Any

# Two workers with two threads each wait for each other on two cores; to be said before anything imports torch.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch
import typer

# Programs that tests start find the scripted engine as pytest does: a folder on the import path is an installation to Python.
_FAKE_ENGINE = str(Path(__file__).parent / "fake_engine")
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (_FAKE_ENGINE, os.environ.get("PYTHONPATH"))))


gc.disable()  # until all is imported: most of it stays


class _Checkout:
    @pytest.hookimpl(tryfirst=True)
    def pytest_collect_directory(self, path: Path, parent: pytest.Collector) -> pytest.Collector | None:
        """Take the checkout for a folder of tests; it is the package itself."""
        return pytest.Dir.from_parent(parent, path=path) if path == Path(__file__).parents[1] else None


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(_Checkout())


def pytest_collection_finish() -> None:
    """Leave what was imported out of every search for garbage, without a first search, which would take a second."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(50_000, 20, 20)  # tests leave little behind, and the searches took a fiftieth of the time


@pytest.fixture(scope="session", autouse=True)
def no_test_waits_for_the_disk() -> Iterator[None]:
    """Files are flushed to the disk thousands of times, a hundredth of a second each; ``test_writing.py`` counts the calls."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def nothing_is_found_twice() -> Iterator[None]:
    """Typer's runner builds all commands anew for every line, and Python searches all that is installed for every plug-in.

    Either takes longer than most of what is tested.
    """
    found = cache(lambda folder: [(each.name, each.entry_points) for each in distributions(path=[folder])])

    def entry_points(group: str) -> list[EntryPoint]:
        installed = dict(each for folder in reversed(sys.path) for each in reversed(found(folder)))
        return [entry for entries in reversed(installed.values()) for entry in entries if entry.group == group]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.testing._get_command", cache(typer.main.get_command))
        patch.setattr("gaitgauge.files.plugins.entry_points", entry_points)
        yield


@pytest.fixture(scope="session", autouse=True)
def robots_that_ship_are_read_once() -> Iterator[None]:
    """Nearly every test begins with one of them, and takes longer to read and compile it than for anything else."""
    import mujoco
    from gaitgauge.robots import Robot, loading, registry
    from gaitgauge.robots.anatomy import body_plan

    own, folder = registry._own(), Path(registry.__file__).resolve().parent
    named, files, compiled = registry._named, loading.model_files, mujoco.MjModel.from_xml_path
    known, listed, model = cache(named), cache(files), cache(compiled)
    plain, digests = loading.robot_digest, {}
    compile_robot, shape = body_plan.robot_model, cache(lambda mjcf: body_plan.physical_spec(mjcf).compile())

    def named_once(text: str) -> Robot:
        if text not in own:
            return named(text)
        robot = known(text)
        if id(robot) not in digests:
            digests[id(robot)] = plain(robot)
        return robot

    def robot_digest(robot: Robot) -> str:
        return digests.get(id(robot)) or plain(robot)

    def ships(path: str | Path, *others: object) -> bool:
        return not any(others) and Path(path).is_relative_to(folder)

    def robot_model(robot: Robot) -> mujoco.MjModel:
        return copy(shape(robot.mjcf)) if ships(robot.mjcf) else compile_robot(robot)

    def model_files(mjcf: Path, *, within: Path | None = None) -> list[Path]:
        return list(listed(mjcf)) if ships(mjcf, within) else files(mjcf, within=within)

    def from_xml_path(path: str, *assets: object) -> mujoco.MjModel:
        return copy(model(path)) if ships(path, *assets) else compiled(path, *assets)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_named", named_once)
        for module in (
            *("robots.checks.checking", "robots.identity", "gauge.evaluate", "training.tasks"),
            *("studies.consistency.prepared", "studies.compare.contestants", "studies.cards.verify"),
        ):
            patch.setattr(f"gaitgauge.{module}.robot_digest", robot_digest)
        patch.setattr(body_plan, "robot_model", robot_model)
        patch.setattr(loading, "model_files", model_files)
        patch.setattr(mujoco.MjModel, "from_xml_path", staticmethod(from_xml_path))
        yield


@pytest.fixture(scope="session", autouse=True)
def suites_that_ship_are_read_once() -> Iterator[None]:
    """Every suite of a test's own extends one, whose text takes longer to read than all the rest."""
    from gaitgauge.gauge import suite

    plain, read = suite._tables, {}

    def tables(name: str, behind: tuple[Path, ...]) -> tuple[Path, dict[str, Any]]:
        if name not in ("gaitgauge-1", "robogauge-1.1"):
            return plain(name, behind)
        place = suite.SUITE_FOLDER, name
        if place not in read:
            read[place] = plain(name, ())
        path, data = read[place]
        return path, deepcopy(data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(suite, "_tables", tables)
        yield


@pytest.fixture(scope="session", autouse=True)
def noise_of_a_seed_is_drawn_once() -> Iterator[None]:
    """Python draws the reference's noise number by number, which took a third of the time of the gauge's tests."""
    from gaitgauge.gauge.play.noise import ReferenceStream

    plain, drawn = ReferenceStream._tables, {}

    def tables(self: ReferenceStream, generators: list[random.Random], count: int) -> tuple[torch.Tensor, torch.Tensor]:
        if len(generators) != 1:
            return plain(self, generators, count)
        place = (generators[0].getstate(), count, self._noise.latency, tuple(self._half))
        if place not in drawn:
            drawn[place] = plain(self, generators, count), generators[0].getstate()
        made, after = drawn[place]
        generators[0].setstate(after)
        return tuple(table.to(self._device) for table in made)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ReferenceStream, "_tables", tables)
        yield


class _Content(pickle.Pickler):
    """Pickles a tensor as its numbers: torch writes the address of its memory, too."""

    def reducer_override(self, value: object) -> Any:
        if isinstance(value, torch.Tensor):
            kind = f"{type(value)} {value.dtype} {tuple(value.shape)} {value.requires_grad}"
            return bytes, (kind.encode() + value.detach().numpy().tobytes(),)
        return NotImplemented


def content(network: torch.nn.Module) -> bytes:
    file = io.BytesIO()
    _Content(file).dump(network)
    return file.getvalue()


@pytest.fixture(scope="session", autouse=True)
def networks_are_recorded_once() -> Iterator[None]:
    """Most tests play one of a few networks, and recording it takes longer than what is played."""
    from gaitgauge.policy import batch_invariance, native

    plain, recorded = native.frozen, {}

    def frozen(network: torch.nn.Module, num_episodes: int) -> object:
        try:
            place = num_episodes, content(network.eval())
        except (pickle.PicklingError, AttributeError, TypeError):  # made inside of a test
            return plain(network, num_episodes)
        if place not in recorded:
            made = plain(network, num_episodes)
            recorded[place] = None if made is network else made
        return network if recorded[place] is None else recorded[place]

    same, found = batch_invariance._same, {}

    def same_once(policy: Any, count: int) -> bool:
        if type(policy) is not native.NativePolicy:
            return same(policy, count)
        try:
            place = count, policy.contract.hash, content(policy.network.eval())
        except (pickle.PicklingError, AttributeError, TypeError):
            return same(policy, count)
        if place not in found:
            found[place] = same(policy, count)
        return found[place]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native, "frozen", frozen)
        patch.setattr(batch_invariance, "_same", same_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def figures_of_results_are_checked_once() -> Iterator[None]:
    """Cards that ship and copies of one run are read again and again; whoever changes a figure has another text."""
    from gaitgauge.gauge.report import page
    from gaitgauge.studies.compare import comparison

    plain, sound = comparison.check_figures, set()

    def check_figures(result: Any, source: str, error: type[Exception], *, intervals: bool = True) -> None:
        place = intervals, json.dumps(result.to_data())
        if place not in sound:
            plain(result, source, error, intervals=intervals)
            sound.add(place)

    with pytest.MonkeyPatch.context() as patch:
        for module in (comparison, page):
            patch.setattr(module, "check_figures", check_figures)
        yield


@pytest.fixture(scope="module")
def robots_are_tried_here() -> Iterator[None]:
    """Robots of a test's own need no process of their own to be compiled in: ``test_hostile_models.py`` needs it."""
    from gaitgauge.robots.checks import checking, examining
    from gaitgauge.robots.describing import drafting
    from gaitgauge.robots.loading import model_files

    def run_here(work: Callable[[], str | None], mjcf: Path) -> str:
        model_files(mjcf)
        return work() or ""

    with pytest.MonkeyPatch.context() as patch:
        for module in (checking, drafting, examining):
            patch.setattr(module, "run_apart", run_here)
        yield


@pytest.fixture(scope="module")
def programs_run_here() -> Iterator[None]:
    """Programs of a test's own need no process of their own, which takes longer than they do: ``test_fence_process.py`` needs it."""
    from gaitgauge.policy.base import PolicyError
    from gaitgauge.policy.foreign.fence import child

    class Here(child.Child):
        def __init__(self, make: Callable[[bytes, str], child.Program], data: bytes, *, source: str) -> None:
            self._source, self._dropped, self._sessions, self._program = source, [], {}, None
            self._memory = child._shared_memory()[0]
            self._program = self._guarded(lambda: make(data, source))

        def _guarded(self, work: Callable[[], Any]) -> Any:
            enabled = torch._C._get_mkldnn_enabled()
            torch._C._set_mkldnn_enabled(False)  # as in that process
            try:
                with torch.inference_mode():
                    return work()
            except Exception as error:
                raise PolicyError(child._reason(error, self._source).decode()) from error
            finally:
                torch._C._set_mkldnn_enabled(enabled)

        def _exchange(self, message: bytes) -> bytes:
            request = json.loads(message)
            answer = self._guarded(lambda: child._answer(self._program, self._sessions, self._memory, request))
            return json.dumps(answer).encode()

        def act(
            self, session: child.ChildSession, observation: torch.Tensor, forget: torch.Tensor | None
        ) -> torch.Tensor:
            played, numbers = self._sessions[session.number]
            numbers.observation.copy_(observation)
            if forget is not None:
                self._guarded(lambda: played.reset(forget))
            numbers.action.copy_(self._guarded(lambda: played.act(numbers.observation.clone())))
            return numbers.action.clone()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(child, "Child", Here)
        yield


@pytest.fixture
def hangups() -> Iterator[None]:
    """SIGHUP ends a process, as in a terminal, also where the tests run under nohup, which hands on that it is ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)

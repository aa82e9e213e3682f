"""One evaluation, from a request to ``results.json``, in four steps.

``plan``: an environment and the records there are say what is required next, and what counts.
``workers``: play the episodes that the ``dispatcher`` pushes to them, and send records back.
``rollout``: what a worker does: a loop over the worlds of one backend.
``results``: the counted records become rows and scores.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ..backends.registry import choose_device, engine_class, find_backend, make_backend
from ..files.choices import cpu_threads
from ..files.parsing import one_line, shown
from ..files.provenance import plugins, provenance, source_digest, versions
from ..files.writing import json_text, write_atomically
from ..policy.loading import load_policy
from ..policy.native import FilePolicy
from ..policy.robot_of import robot_for
from ..robots import Robot, load_robot
from ..robots.loading import robot_digest
from ..terrains.registry import make_terrain, terrain_names
from .coverage import coverage
from .described import describe
from .episodes import QUALITY
from .fit import check_fit
from .goals import TARGET, check_goals, check_terrain, count_sub_commands
from .motors import parameters_digest, suite_parameters, with_parameters
from .pipelines import PIPELINES, Environment, check_friction, check_payload, make_environments
from .plan import Plan, PlanRules, environment_result, plan
from .play.cluster import Cluster, ClusterError, ClusterWorkers, check_address
from .play.dispatcher import Speculation, play
from .play.progress import ProgressMeter, Status, watcher
from .play.remaining import CPU_COST, GPU_COST
from .play.segments import count_segments
from .play.workers import Job, local_workers, start_workers
from .request import Request
from .result import ClusterName, Provenance, Result
from .results import fold, rows_csv
from .store import RunFolder, StoreError
from .suite import Suite, SuiteError, load_suite
from .suited import measured, suited
from .totals import health_of

_WORLDS = 24
"""Worlds of a worker on the CPU: more worlds amortize the loop's overhead; fewer balance the load at the end."""
_GPU_WORLDS = 4096
"""Largest number of worlds on a GPU."""
GPU_SPECULATION = Speculation(at_work=_GPU_WORLDS, test_probability=0.02, quality_probability=0.25)
"""A GPU plays nearly every level of every search at once, and quality while the last level tests run: the number
of control steps in a row dominates the run time, and at the end most worlds have nothing to do."""
_EARLY = 16
"""Episodes of a worker on the CPU up to which it plays others speculatively: more of them slow those that are required."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A request that can be carried out, with the suite, robot and policy that it names."""

    request: Request
    device: str
    """Device of the engine: that of the request, else the one that the engine is made for."""
    suite: Suite
    robot: Robot
    policy: FilePolicy
    environments: tuple[Environment, ...]
    seeds: tuple[int, ...]
    """Seeds of the quality episodes."""

    @property
    def rules(self) -> PlanRules:
        """The rules that plans depend on."""
        return PlanRules(suite=self.suite, seeds=self.seeds, quality=self.request.pipeline != "level")


def prepare(request: Request) -> Prepared:
    """Check a request and load what it names.

    Raises:
        SuiteError, RobotError, TerrainError, PolicyError, ContractError, BackendError, ClusterError: one sentence on what is wrong.
    """
    suite = load_suite(request.suite)
    device = choose_device(request.backend, request.device)
    # None with a cluster stands for all of its processors
    threads = request.threads if request.cluster is not None else cpu_threads(request.threads)
    request = replace(request, device=device, threads=threads)
    engine = find_backend(request.backend, device)
    if request.cluster is not None:
        check_address(request.cluster)
        if not engine.parallel_processes or torch.device(device).type != "cpu":
            raise ClusterError(
                f"a cluster plays with an engine that runs as several processes on CPUs, which backend '{request.backend}' on "
                f"'{device}' does not; leave out --cluster, --backend or --device"
            )
    terrains, level = _terrains(request, suite), request.level
    for friction in request.frictions:
        check_friction(friction)
    for payload in request.payloads:
        check_payload(payload)
    for seed in request.seeds:
        if not 0 <= seed < 2**63:
            raise SuiteError(
                f"seed {shown(seed)} is not possible; give a whole number of at least 0 and below 2^63 (--seed)"
            )
    frictions, payloads, seeds = request.frictions, request.payloads, request.seeds or suite.matrix.seeds
    if request.pipeline == "base":
        frictions = frictions or (suite.matrix.nominal_friction,)
        payloads = payloads or (suite.matrix.nominal_payload,)
        seeds = seeds[:1]
        if len(terrains) * len(frictions) * len(payloads) != 1:
            raise SuiteError(
                "pipeline 'base' plays one environment; give one --terrain, --friction and --payload, or use multi"
            )
    environments = make_environments(
        suite, terrains=terrains, frictions=frictions or None, payloads=payloads or None, level=level
    )
    check_goals(suite, searched=any(e.searched for e in environments), judged=request.pipeline != "level")
    for name, environment in {e.terrain: e for e in environments}.items():
        highest = suite.scoring.levels if environment.level is None else environment.level
        check_terrain(suite, make_terrain(name, int(highest)), searched=environment.searched)
    # foreign files take their contract from the robot that is asked for
    asked = None if request.robot is None else load_robot(request.robot)
    policy = load_policy(request.policy, asked, trust=request.trust, contract_file=request.contract)
    robot = robot_for(policy.contract, request.robot)
    suite = measured(suited(suite, policy.contract), robot)
    robot = with_parameters(suite, robot, request.parameters)
    check_fit(suite, robot, policy.contract)
    return Prepared(
        request=request,
        device=device,
        suite=suite,
        robot=robot,
        policy=policy,
        environments=tuple(environments),
        seeds=tuple(dict.fromkeys(seeds)),
    )


def _terrains(request: Request, suite: Suite) -> list[str]:
    """Return the terrains of a request, in the suite's order."""
    if request.pipeline not in PIPELINES:
        raise SuiteError(
            f"there is no pipeline '{one_line(request.pipeline, 80)}'; choose one of {', '.join(PIPELINES)}"
        )
    for name in request.terrains:
        if name not in terrain_names():
            make_terrain(name)  # raises with the nearest names
    order = list(suite.matrix.terrains)
    chosen = sorted(set(request.terrains), key=lambda t: (order.index(t) if t in order else len(order), t))
    if request.pipeline in ("base", "multi"):
        chosen = chosen or order[:1]
    if request.level is not None and chosen and all(t == "flat" for t in chosen):
        raise SuiteError(f"terrain 'flat' has no levels, so --level {request.level} means nothing; leave it out")
    if request.pipeline in ("base", "multi"):
        if request.level is None and any(t != "flat" for t in chosen):
            raise SuiteError(
                f"pipeline '{request.pipeline}' plays one level of terrain '{chosen[-1]}'; say which with --level"
            )
        return chosen
    chosen = chosen or order
    if request.pipeline == "level":
        if request.level is not None:
            raise SuiteError("pipeline 'level' searches the level; leave --level out, or use pipeline 'multi'")
        chosen = [t for t in chosen if t != "flat"]
        if not chosen:
            raise SuiteError("terrain 'flat' has no levels to search; choose another --terrain, or pipeline 'multi'")
    return chosen


def identity(prepared: Prepared) -> dict[str, Any]:
    """Return what decides about the results: a folder that holds another run is refused."""
    request = prepared.request
    return common_identity(prepared.suite, prepared.policy.digest, prepared.robot, prepared.device, prepared.seeds) | {
        "pipeline": request.pipeline,
        "backend": request.backend,
        "robot": request.robot or prepared.robot.name,
        "level": request.level,
        "environments": [e.key for e in prepared.environments],
        "noise": "by segment",  # runs begun before episodes fell into segments drew theirs otherwise
        **_parameters(prepared),
    }


def _parameters(prepared: Prepared) -> dict[str, str]:
    """Return the digest of a parameter set that was asked for; nothing where the suite's own is played."""
    if prepared.request.parameters is None:
        return {}
    return {"parameters": parameters_digest(suite_parameters(prepared.suite, prepared.robot))}


def common_identity(suite: Suite, policy: str, robot: Robot, device: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Return the part of it that every run of episodes has; ``policy`` is its digest."""
    return {
        "suite": f"{suite.name} {suite.version}",
        "suite_digest": suite.digest,
        "policy": policy,
        "robot_digest": robot_digest(robot),
        "device": torch.device(device).type,
        "seeds": list(seeds),
        "versions": versions(),
        "plugins": plugins(),
    }


def evaluate(
    request: Request | Prepared,
    folder: Path,
    *,
    resume: bool = False,
    command: Sequence[str] = (),
    watch: Callable[[Status], None] | None = None,
) -> Result:
    """Evaluate a policy; every finished episode is on disk at once, so that nothing is lost when the process is killed.

    Args:
        folder: where ``results.json``, ``episodes.csv``, ``report.html`` and ``episodes/`` go.
        resume: go on with what the folder holds.

    Raises:
        SuiteError, RobotError, PolicyError, ContractError, BackendError, WorkerError, ClusterError, StoreError, RecordError: one
            sentence.
    """
    began = time.perf_counter()
    prepared = request if isinstance(request, Prepared) else prepare(request)
    request, suite, rules = prepared.request, prepared.suite, prepared.rules
    if torch.device(prepared.device).type == "cpu":
        torch.set_num_threads(1)  # several would change the last bits of the policy's output
    planners = [partial(plan, environment, rules=rules) for environment in prepared.environments]
    expected = GPU_COST if torch.device(prepared.device).type == "cuda" else CPU_COST
    on_progress = watch and watcher(ProgressMeter(suite, began, expected), watch)
    with ExitStack() as stack:
        cluster = None if request.cluster is None else stack.enter_context(closing(Cluster(request.cluster)))
        store = stack.enter_context(RunFolder(folder, identity(prepared), resume=resume))
        plans = [planner(store.records) for planner in planners]
        job, count, speculation = _workers(prepared, plans, cluster)
        forked = engine_class(request.backend).forkable()
        with closing(cluster.workers(job, count) if cluster else start_workers(job, count, forked=forked)) as workers:
            effort = play(planners, store.records, store.put, workers, speculation=speculation, watch=on_progress)
        outcomes = [environment_result(environment, store.records, rules) for environment in prepared.environments]
        counted = [record for outcome in outcomes for record in (*outcome.trials, *outcome.records)]
        scores = fold(suite, outcomes, (*suite.metrics.weights, QUALITY), evaluated=rules.quality)
        engine = find_backend(request.backend, prepared.device)
        digests = {"policy": prepared.policy.digest, "robot": robot_digest(prepared.robot)}
        digests |= {"suite": suite.digest, "source": source_digest()} | _parameters(prepared)
        result = Result(
            **vars(scores),
            **vars(
                describe(suite, prepared.robot, prepared.policy, engine, {e.terrain for e in prepared.environments})
            ),
            coverage=coverage(suite, prepared.environments, prepared.seeds, pipeline=request.pipeline),
            pipeline=request.pipeline,
            backend=request.backend,
            health=health_of(scores.environments),
            provenance=Provenance(
                **provenance(
                    command=command, device=prepared.device, threads=request.threads or count, digests=digests
                ),
                seconds=round(time.perf_counter() - began, 2),
                physics_steps=effort.physics_steps,
                processes=count,
                set_aside=tuple(path.name for path in store.damaged),
                cluster=None
                if request.cluster is None or not isinstance(workers, ClusterWorkers)
                else ClusterName(address=request.cluster, processors=tuple(sorted(workers.processors))),
                engine_seconds=None if effort.engine_seconds is None else round(effort.engine_seconds, 2),
            ),
        )
        write_atomically(folder / "episodes.csv", rows_csv(counted), StoreError)
        write_atomically(folder / "results.json", json_text(result.to_data()), StoreError)
        store.discard_all_but([record.episode for record in counted])
    return result


def _workers(prepared: Prepared, plans: Sequence[Plan], cluster: Cluster | None) -> tuple[Job, int, Speculation]:
    """Return the job of the workers, their number, and the rule by which they play speculatively."""
    request, suite = prepared.request, prepared.suite
    places = [
        (e.terrain, level)
        for e in prepared.environments
        for level in ([int(e.level)] if e.level is not None else range(1, suite.scoring.levels + 1))
    ]
    required = [episode for found in plans for episode in found.required]
    on_gpu = torch.device(prepared.device).type != "cpu"
    threads, most = request.threads or 1, len(required)
    if cluster is not None:
        count = max(min(request.threads or cluster.cpus, cluster.cpus, most), 1)
    else:
        count = local_workers(request.backend, prepared.device, threads=threads, most=most)
    if on_gpu:
        speculation = GPU_SPECULATION
        segments = sum(count_segments(e, suite) for e in (*required, *speculation.choose(plans, required)))
        worlds = min(max(segments, 1), _GPU_WORLDS)
    else:
        walk = sum(count_sub_commands(suite, g.name) for g in suite.goals if g.name != TARGET)
        each = max(len(prepared.seeds) * walk, len(suite.matrix.search_seeds))
        worlds = min(len(prepared.environments) * each, _WORLDS)
        # a single worker has no core to spare
        speculation = Speculation(at_work=_EARLY * count if count > 1 else 0)
    job = Job(
        suite=suite,
        policy=prepared.policy,
        robot=prepared.robot,
        places=tuple(dict.fromkeys(places)),
        worlds=worlds,
        build=partial(make_backend, request.backend, device=prepared.device),
        threads=1 if cluster is not None else max(threads // count, 1),
    )
    return job, count, speculation

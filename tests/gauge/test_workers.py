"""Workers in processes: messages there and back, how they end, and what is said when one does not."""

import time

import pytest
from gaitgauge.gauge.play.workers import Drop, Failed, Finished, Job, LocalProcesses, Play, Progress, Stop, WorkerError
from gaitgauge.policy.base import PolicyError
from scripted_gauge import DIAGONAL, GO2, MAXIMUM, Puppet, ScriptedPolicy, episode, short_suite


def puppets(scene, *, threads):
    return Puppet(scene)


def job(*, build=puppets, policy=None):
    suite = short_suite("gaitgauge-1")
    return Job(
        suite=suite,
        policy=policy or ScriptedPolicy(),
        robot=GO2,
        places=(("flat", 0),),
        worlds=8,
        build=build,
    )


def until(workers, done):
    """Messages up to the first after which enough has come."""
    heard = []
    while not done(heard):
        heard += workers.receive()
    return heard


@pytest.fixture
def two():
    workers = LocalProcesses(job(), 2)
    yield workers
    workers.close()


def finished(heard, worker):
    return [m.record.episode for w, m in heard if w == worker and isinstance(m, Finished)]


def test_each_worker_plays_what_it_is_sent_and_stops_when_told(two):
    walks = [episode(MAXIMUM, seed=seed) for seed in range(3)]
    two.send(0, Play(walks[:2]))
    two.send(1, Play(walks[2:]))
    heard = until(two, lambda heard: len(finished(heard, 0)) == 2 and len(finished(heard, 1)) == 1)
    assert (finished(heard, 0), finished(heard, 1)) == (walks[:2], walks[2:])
    two.send(0, Stop())
    time.sleep(0.3)  # its process has ended before the other one is told
    two.send(1, Stop())
    last = until(two, lambda heard: sum(isinstance(m, Progress) and m.stopped for _, m in heard) == 2)
    assert {w for w, m in last if isinstance(m, Progress) and m.stopped} == {0, 1}


def test_a_worker_says_when_it_has_room_and_what_it_has_heard_of(two):
    def reported(**wanted):
        return lambda heard: any(
            w == 0 and isinstance(m, Progress) and all(getattr(m, k) == v for k, v in wanted.items()) for w, m in heard
        )

    until(two, reported(room=8, played=0))
    two.send(0, Play([episode(MAXIMUM)]))  # six segments
    until(two, reported(room=2, played=1))
    until(two, reported(room=8, played=1, active={}))


def test_no_record_comes_of_an_episode_that_is_cancelled_before_it_begins(two):
    long, short = episode(DIAGONAL, MAXIMUM, seed=1), episode(MAXIMUM, seed=2)
    two.send(0, Play([long, short]))
    two.send(0, Drop([long]))
    assert finished(until(two, lambda heard: finished(heard, 0)), 0) == [short]
    two.send(0, Stop())
    assert finished(until(two, lambda heard: any(isinstance(m, Progress) and m.stopped for _, m in heard)), 0) == []


@pytest.mark.parametrize("late", [False, True])
def test_errors_keep_their_class_and_words(late):
    """Also where something is sent to a process that has ended, and its error was not heard yet."""

    def broken(scene, *, threads):
        raise PolicyError("no such thing; take another")

    workers = LocalProcesses(job(build=broken), 1)
    if late:
        workers._processes[0].join()
        workers.send(0, Stop())
    ((worker, message),) = until(workers, bool)
    workers.close()
    assert (worker, type(message)) == (0, Failed)
    assert isinstance(message.error, PolicyError)
    assert str(message.error) == "no such thing; take another"


def test_a_process_that_is_gone_is_one_sentence(two):
    two._processes[1].kill()
    with pytest.raises(WorkerError, match=r"was ended by signal 9; what had finished is kept: go on with --resume"):
        until(two, lambda heard: False)

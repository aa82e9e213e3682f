"""What the terminal shows: names as they are, one line for each mistake, whatever the file system does."""

import errno
import io
import logging
import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest
import typer
from gaitgauge.cli.console import Terminal, make_table, shell_command
from gaitgauge.cli.errors import UserError, report_errors
from gaitgauge.cli.main import main
from gaitgauge.cli.progress import ProgressDisplay, _starting_again, duration
from rich.text import Text

PROGRAM = "from gaitgauge.cli.main import main; main()"


def shown(show):
    terminal = Terminal()
    terminal.file = io.StringIO()
    show(terminal)
    return terminal.file.getvalue()


@pytest.mark.parametrize("name", ["[/x]", "runs[v2]", "[bold]", ":smile:", "[link=file:///etc]x[/link]"])
def test_names_are_no_markup(name):
    table = make_table(name, name)
    table.add_row(name)
    assert shown(lambda t: t.say(f"folder {name}")) == f"folder {name}\n"
    assert shown(lambda t: t.print(table)).count(name) == 3


def test_control_characters_are_escaped():
    table = make_table("a\x1b]0;title\x07", "b\x1b[2J")
    table.add_row("c\x9b31m\r")
    assert shown(lambda t: t.say("x\x1b[31m\r\x00")) == "x\\x1b[31m\\r\\x00\n"
    assert not set("\x1b\x07\x9b\r") & set(shown(lambda t: t.print(table)))
    assert shown(lambda t: t.say(Text.assemble(("x\x1b[31m", "bold"), "\u202e\x00"))) == "x\\x1b[31m\\u202e\\x00\n"


@pytest.mark.parametrize("name", [b"\xff", b"\x1b[31m"])
def test_a_page_whose_name_is_no_text_is_named(run, tmp_path, name):
    card = (Path(__file__).parents[1] / "fuzz" / "seeds" / "results" / "results.json").read_text()
    (tmp_path / "card.json").write_text(card)
    (tmp_path / "other.json").write_text(card.replace("policy.pt", "other.pt"))
    page = os.fsdecode(name) + ".html"
    for arguments in (("board", ".", "--out", page), ("compare", "card.json", "other.json", "--out", page + "s")):
        result = run(*arguments)
        assert result.exit_code == 0, result.exception
        assert not set("\x1b\udcff") & set(result.output)
    assert (tmp_path / page).is_file()


def test_commands_can_be_pasted_into_a_shell(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["gaitgauge", "evaluate", "a b.pt", "--out", "runs[v2]", "--resume"])
    assert shell_command(None, "--resume") == "gaitgauge evaluate 'a b.pt' --out 'runs[v2]' --resume"
    assert shell_command(["train", "$(x)"]) == "gaitgauge train '$(x)'"


def test_progress_is_plain_lines_without_a_terminal(monkeypatch):
    clock = iter([0.0, 5.0, 5.0, 12.0, 12.0, 13.0, 13.0, 14.0, 14.0])
    monkeypatch.setattr("gaitgauge.cli.progress._TICK", 100.0)

    def show(terminal):
        with ProgressDisplay(terminal, "gauging", clock=lambda: next(clock)) as display:
            display.update(0.1, "1 of 9")
            display.update(0.2, "2 of 9", {"now:": "[/flat]"})
            display.update(0.3, "3 of 9")
            display.update(1.0, "9 of 9", last=True)

    assert shown(show) == "12 s: gauging, 2 of 9, now: [/flat]\n14 s: gauging, 9 of 9\n"


def test_no_display_is_silent_while_nothing_is_heard(monkeypatch):
    """An engine compiled for minutes without a line; between two updates the remaining time counts down."""
    monkeypatch.setattr("gaitgauge.cli.progress._TICK", 0.001)
    now = 0.0

    def show(terminal):
        nonlocal now
        with ProgressDisplay(terminal, "gauging", clock=lambda: now) as display:
            for now in (9.0, 18.0):
                _until(terminal, f"{now:g} s: ")
            display.update(0.5, "1 of 2", left=25.0)
            for now in (27.0, 45.0):
                _until(terminal, f"{now:g} s: ")

    lines = "9 s: gauging, starting", "18 s: gauging, starting", "27 s: gauging, 1 of 2, about 16 s left"
    assert shown(show).splitlines() == [*lines, "45 s: gauging, 1 of 2, about 1 s left"]


def test_a_command_is_not_silent_while_it_imports_and_reads(monkeypatch):
    """Nothing was shown for 69 s on a busy machine until the first display; its clock goes on from the command's start."""
    monkeypatch.setattr("gaitgauge.cli.progress._TICK", 0.001)
    monkeypatch.setattr("time.process_time", lambda: 18.0)
    now = 0.0

    def show(terminal):
        nonlocal now
        with ProgressDisplay.of_start(terminal, "evaluate", clock=lambda: now):
            for now in (9.0, 18.0):
                _until(terminal, f"{now:g} s: ")
            with ProgressDisplay(terminal, "gauging", clock=lambda: now) as display:
                now = 27.0
                display.update(0.5, "1 of 2", left=25.0)
        with ProgressDisplay(terminal, "another", clock=lambda: now) as display:
            display.update(1.0, "1 of 1", last=True)

    lines = "9 s: evaluate, starting", "18 s: evaluate, starting", "27 s: gauging, 1 of 2, about 30 s left"
    # a start of 18 s means that the page and the tables take 0.3 times as long
    assert shown(show).splitlines() == [*lines, "0 s: another, 1 of 1"]


def test_the_clock_may_begin_before_the_display(monkeypatch):
    """A training that had imported for 19 s said 57 s of its first iteration, 75 s after the command."""
    monkeypatch.setattr("gaitgauge.cli.progress._TICK", 10.0)
    now = 19.0

    def show(terminal):
        nonlocal now
        with ProgressDisplay(terminal, "training", clock=lambda: now, began=0.0) as display:
            now = 75.0
            display.update(0.5, "iteration 1 of 2", last=True)

    assert shown(show).startswith("1 min 15 s: training, iteration 1 of 2")


@pytest.mark.parametrize(("load", "again"), [(0.5, 3.0), (8.0, 6.0), (80.0, 20.0)])
def test_another_start_finds_its_files_in_memory(monkeypatch, load, again):
    """The first one read packages for 20 s from a cold disk, of which 3 s were work; the end and the film were told too long."""
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0), raising=False)
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    monkeypatch.setattr("time.process_time", lambda: 3.0)
    assert _starting_again(20.0) == again


def test_the_end_searches_for_no_garbage(monkeypatch):
    """A jury was silent for 5 s after its last word, and on a busy machine for 27 s."""
    frozen = []
    monkeypatch.setattr("gc.freeze", lambda: frozen.append(True))
    monkeypatch.setattr("sys.argv", ["gaitgauge", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert frozen == [True]


STARTED = "evaluate p|compare p q|verify c|jury p|consistency p|trial p|worst p|latent p|sweep s|replay r --robot go2"


@pytest.mark.parametrize("arguments", [line.split() for line in STARTED.split("|")], ids=lambda line: line[0])
def test_commands_that_take_long_say_so_from_the_start(refused, monkeypatch, arguments):
    def of_start(console, title):
        raise UserError(f"{title} shows that it starts")

    monkeypatch.setattr(ProgressDisplay, "of_start", of_start)
    assert f"{arguments[0]} shows that it starts" in refused(*arguments)


def _until(terminal, text):
    """Wait until a terminal shows a text."""
    for _ in range(5000):
        if text in terminal.file.getvalue():
            return
        time.sleep(0.001)
    raise AssertionError(f"no {text}")


def test_progress_is_a_block_on_a_terminal():
    terminal = Terminal()
    terminal.file, terminal._force_terminal = io.StringIO(), True
    with ProgressDisplay(terminal, "gau[/x]ging") as display:
        display.update(0.5, "1 of 2", {"now:": "[bold]"})
    text = terminal.file.getvalue()
    assert "gau[/x]ging" in text and "[bold]" in text and "1 of 2" in text


@pytest.mark.parametrize(("seconds", "text"), [(30.4, "30 s"), (127, "2 min 07 s"), (3901, "1 h 05 min")])
def test_durations_for_people(seconds, text):
    assert duration(seconds) == text


class Unwritable(io.StringIO):
    """A stream that takes nothing."""

    def __init__(self, number):
        super().__init__()
        self.number = number

    def write(self, text):
        raise OSError(self.number, os.strerror(self.number))


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EIO])
@pytest.mark.parametrize("block", [False, True])
def test_what_nobody_reads_any_more_is_lost_and_the_command_goes_on(number, block):
    """The reader of a pipe has left, the window of a terminal was closed."""
    terminal = Terminal()
    terminal.file, terminal._force_terminal = Unwritable(number), block
    with ProgressDisplay(terminal, "gauging") as display:
        display.update(1.0, "9 of 9", last=True)
        terminal.say("done")
    terminal.say("really")


def test_a_full_disk_is_an_error_where_results_are_said_alone():
    for options, said in (({}, False), ({"may_lose": True}, True), ({"stderr": True}, True)):
        terminal = Terminal(**options)
        terminal.file = Unwritable(errno.ENOSPC)
        with nullcontext() if said else pytest.raises(OSError, match="No space left"):
            terminal.say("0.7")


def test_nothing_is_left_in_a_broken_pipe_that_would_fail_at_the_end(monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        monkeypatch.setattr(sys, "stderr", closed)
        terminal = Terminal(stderr=True)
        terminal.say("lost")
        terminal.say("lost, too")
        closed.flush()


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, "output cannot be written: no space left on device"),
        (errno.EAGAIN, "the system refused: resource temporarily unavailable"),
    ],
)
def test_a_refusal_without_a_file_is_of_the_output_only_where_writing_can_say_so(monkeypatch, capsys, number, said):
    """A process that cannot be started has no file's name either."""
    silenced = []
    monkeypatch.setattr("gaitgauge.cli.errors.silence", silenced.append)

    @report_errors
    def command():
        raise OSError(number, os.strerror(number))

    with pytest.raises(typer.Exit):
        command()
    assert capsys.readouterr().err == f"gaitgauge: {said}\n"
    assert bool(silenced) == (number == errno.ENOSPC)


def test_an_error_that_cannot_be_told_keeps_its_exit_code(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Unwritable(errno.EIO))

    @report_errors
    def command() -> None:
        logging.getLogger("gaitgauge.policy.foreign.fenced_policy").warning("slow")
        Terminal(stderr=True).say("half of it")
        raise UserError("wrong")

    with pytest.raises(typer.Exit) as ended:
        command()
    assert ended.value.exit_code == 2


@pytest.mark.parametrize("arguments", [("list", "suites"), ("--version",)])
def test_a_full_disk_behind_standard_output_is_one_sentence(arguments):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, timeout=120
        )
    assert done.returncode == 2
    assert done.stderr == "gaitgauge: output cannot be written: no space left on device\n"


def test_letters_that_the_terminal_does_not_have_are_escaped():
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, "list", "suites"], env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "\\xd7" in done.stdout, "a times sign stands in a suite's title"


def test_a_folder_that_was_removed_is_one_sentence(tmp_path):
    (tmp_path / "gone").mkdir()
    command = f"cd {tmp_path}/gone && rmdir ../gone && {sys.executable} -c '{PROGRAM}' list policies"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.endswith("gaitgauge: the current folder does not exist any more; change to another one\n")


@pytest.mark.parametrize(
    "program", [f"'{PROGRAM}' list suites", "'from gaitgauge.cli.console import print_json; print_json([1.0])'"]
)
def test_a_reader_that_left_is_no_error(program):
    # `exec <&-` closes the pipe before anything is written to it
    command = f"set -o pipefail; {sys.executable} -c {program} | exec 0<&-"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_folder_s_name_that_is_too_long_is_one_sentence(refused, policy):
    assert "file name too long" in refused("evaluate", policy, "--pipeline", "base", "--out", "x" * 300).lower()
    assert "file name too long" in refused("evaluate", "x" * 300 + ".pt").lower()


@pytest.mark.parametrize("ends", ["well", "with an error", "after a sentence"])
def test_notices_come_first_or_not_at_all(capsys, ends):
    """What fails says one line; a notice never comes after what it is about."""

    @report_errors
    def command() -> None:
        logging.getLogger("gaitgauge.policy.foreign.fenced_policy").warning("%s is slow", "it")
        if ends == "after a sentence":
            Terminal(stderr=True).say("10 s: half of it")
        if ends != "well":
            raise UserError("wrong")

    if ends == "well":
        command()
    else:
        with pytest.raises(typer.Exit):
            command()
    expected = {"well": ["it is slow"], "with an error": ["gaitgauge: wrong"]}
    expected["after a sentence"] = ["it is slow", "10 s: half of it", "gaitgauge: wrong"]
    assert capsys.readouterr().err.splitlines() == expected[ends]

"""Files of tensors that are damaged, or larger than they look: each ends in one sentence before memory is spent."""

import io
import json
import pickle
import zipfile
from dataclasses import replace

import pytest
import torch
from gaitgauge.policy.base import LONGEST_MESSAGE, PolicyError
from gaitgauge.policy.finding import find_policy
from gaitgauge.policy.foreign.deploy_yaml import deploy_contract
from gaitgauge.policy.foreign.fence import archive, pickles
from gaitgauge.policy.foreign.readers import Facts, find_description
from gaitgauge.policy.loading import load_policy
from gaitgauge.policy.native import checksum, save_policy
from gaitgauge.robots import load_robot

WEIGHT = "encoder.0.weight"


def refused(path, named: str) -> str:
    with pytest.raises(PolicyError, match=named) as caught:
        load_policy(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def rewritten(path, change) -> bytes:
    """The archive's bytes after ``change`` of its records, put together with right sums."""
    records = archive.read_archive(path.read_bytes(), source=path.name)
    change(records)
    return archive.packed(records)


def test_an_entry_without_a_name_is_refused(cts_file):
    data = bytearray(cts_file.read_bytes())
    last = data.rindex(b"PK\x01\x02")  # the directory's last entry, whose name's length stands 28 bytes on
    length = int.from_bytes(data[last + 28 : last + 30], "little")
    data[last + 28 : last + 30] = b"\0\0"
    data[last + 32 : last + 34] = length.to_bytes(2, "little")  # what was the name is the comment
    cts_file.write_bytes(data)
    refused(cts_file, "an entry without a name|neither TorchScript nor a torch.save file")


def test_one_flipped_bit_of_a_weight_is_found(cts_file):
    stored = torch.load(cts_file, weights_only=True)["state_dict"][WEIGHT].numpy().tobytes()
    data = bytearray(cts_file.read_bytes())
    data[data.index(stored) + 3] ^= 0x40
    cts_file.write_bytes(data)
    assert torch.load(cts_file, weights_only=True)["state_dict"][WEIGHT].abs().max() > 1e30  # torch reads on
    refused(cts_file, "damaged")


def test_weights_of_another_policy_are_found_where_every_sum_is_right(cts_file):
    entries = torch.load(cts_file, weights_only=True)
    assert entries["checksum"] == checksum(entries)
    entries["state_dict"][WEIGHT][0, 0] += 1.0
    torch.save(entries, cts_file)
    refused(cts_file, "checksum")
    del entries["checksum"]  # files from before it was written
    torch.save(entries, cts_file)
    load_policy(cts_file)


@pytest.mark.parametrize("value", [3, None, "0" * 64, torch.zeros(2)])
def test_a_checksum_that_is_none_is_wrong(cts_file, value):
    entries = torch.load(cts_file, weights_only=True)
    torch.save({**entries, "checksum": value}, cts_file)
    refused(cts_file, "checksum")


def test_an_archive_that_unpacks_to_too_much(cts_file, monkeypatch):
    records = archive.read_archive(cts_file.read_bytes(), source="")
    with zipfile.ZipFile(cts_file, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in records.items():
            made.writestr(f"archive/{name}", content)
        made.writestr("archive/data/9999", bytes(8 * 2**20))
    size = cts_file.stat().st_size
    monkeypatch.setattr(archive, "LARGEST_FILE", 4 * 2**20)
    assert size < archive.LARGEST_FILE
    refused(cts_file, "unpacks to 8 MiB")


def test_an_archive_with_a_record_twice(cts_file):
    with zipfile.ZipFile(cts_file, "a") as made, pytest.warns(UserWarning, match="Duplicate"):
        made.writestr(made.infolist()[0].filename, b"other")
    refused(cts_file, "twice")


def test_tensors_that_are_larger_than_their_storage(tmp_path):
    path = tmp_path / "expanded.pt"
    torch.save({"model_state_dict": {"actor.0.weight": torch.zeros(1).expand(2**31, 45)}}, path)
    assert path.stat().st_size < 10_000
    refused(path, "spelled out")


@pytest.mark.parametrize("field", ["count", "shape", "offset"])
def test_tensors_that_reach_beyond_their_storage(tmp_path, field):
    path = tmp_path / "beyond.pt"
    torch.save({"model_state_dict": {"actor.0.weight": torch.zeros(7, 45)}}, path)

    def change(records):
        text = records["data.pkl"]
        number = {"count": 315, "shape": 7, "offset": 0}[field]
        old = {"count": pickle.BININT2 + number.to_bytes(2, "little"), "shape": b"K\x07K\x2d", "offset": b"QK\x00"}[
            field
        ]
        new = {"count": b"J\xff\xff\xff\x7f", "shape": b"J\xff\xff\xff\x7fK\x2d", "offset": b"QJ\xff\xff\xff\x7f"}[
            field
        ]
        assert old in text
        records["data.pkl"] = text.replace(old, new, 1)

    path.write_bytes(rewritten(path, change))
    refused(path, "missing or short|reaches beyond")


@pytest.mark.parametrize("value", [set, bytearray, torch.zeros(2).to_sparse(), torch.zeros(2, device="meta")])
def test_what_is_no_plain_tensor_is_named(tmp_path, value):
    path = tmp_path / "other.pt"
    torch.save({"model_state_dict": {"actor.0.weight": bytearray(5) if value is bytearray else value}}, path)
    refused(path, "more than tensors and plain data|no gaitgauge|neither|no tensors")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"encoder_hidden": [30_000, 30_000, 30_000]}, "do not fit"),
        ({"frame_width": 10**9}, "1e\\+09"),
        ({"history_length": 65_000}, "do not fit"),
        ({"actor_hidden": [1] * 40_000}, "characters"),
    ],
)
def test_networks_too_large_are_never_built(cts_file, arguments, named):
    entries = torch.load(cts_file, weights_only=True)
    known = json.loads(entries["network"]["arguments"])
    entries["network"]["arguments"] = json.dumps({**known, **arguments})
    torch.save({**entries, "checksum": checksum(entries)}, cts_file)
    refused(cts_file, named)


def test_nested_arguments(cts_file):
    entries = torch.load(cts_file, weights_only=True)
    entries["network"]["arguments"] = "[" * 60_000
    torch.save({**entries, "checksum": checksum(entries)}, cts_file)
    refused(cts_file, "arguments")


ACTOR = {"actor.0.weight": torch.zeros(8, 45), "actor.0.bias": torch.zeros(8)}
ACTOR |= {"actor.2.weight": torch.zeros(12, 8), "actor.2.bias": torch.zeros(12)}
NORMALIZER = {"obs_normalizer._mean": torch.zeros(1, 45), "obs_normalizer._std": torch.ones(1, 45)}


@pytest.mark.parametrize(
    "weights",
    [
        {k: v for k, v in (ACTOR | NORMALIZER).items() if k != "obs_normalizer._std"},
        {k: v for k, v in ACTOR.items() if k != "actor.0.weight"},
        {k: v for k, v in ACTOR.items() if k != "actor.2.bias"},
        ACTOR | {"actor.0.weight": torch.zeros(45)},
        ACTOR | {"actor.0.weight": torch.tensor(1.0)},
        ACTOR | {7: torch.zeros(1)},
        ACTOR | {"actor.0.bias": 3},
        {k: v for k, v in ACTOR.items() if k.endswith("bias")},
        {**ACTOR, "student_encoder.0.weight": torch.zeros(4, 7)},
        torch.zeros(3, 3),
        {},
    ],
)
def test_checkpoints_with_missing_entries(tmp_path, weights):
    path = tmp_path / "model_1.pt"
    torch.save({"model_state_dict": weights, "iter": 1}, path)
    refused(path, "model_1.pt")


NESTED = "[" * 100_000
LAUGHS = "a0: &a0 [x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 40))


@pytest.mark.parametrize("text", [NESTED, LAUGHS, "&a [*a]", "a: !!python/object:os.system x", "x" * 2_000_000, "\0"])
def test_deploy_files_that_never_end(tmp_path, text):
    path = tmp_path / "deploy.yaml"
    path.write_text(text)
    with pytest.raises(PolicyError, match=r"deploy\.yaml") as caught:
        deploy_contract(path, load_robot("go2"))
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("text", [NESTED, '{"a":' * 50_000, "", "null", '"x"', "9" * 10_000, "x" * 2_000_000])
def test_contracts_that_are_none(tmp_path, cts_file, text):
    """Inside a file, and beside one."""
    entries = {**torch.load(cts_file, weights_only=True), "contract": text}
    torch.save({**entries, "checksum": checksum(entries)}, cts_file)
    refused(cts_file, "cts.gauge.pt")
    (tmp_path / "contract.json").write_text(text)
    with pytest.raises(PolicyError, match=r"contract\.json"):
        find_description(tmp_path / "policy.pt", None, Facts())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b".",
        b"\x80\x02",
        b"\x80\x02}q\x00h\x05.",
        b"\x80\x02(((.",
        b"\x80\x02" + b"(" * 100_000 + b"t" * 100_000 + b".",
        b"\x80\x02K\x01K\x01R.",
        b"\x80\x02K\x01Q.",
        b"cos\nsystem\n(S'true'\ntR.",
        pickle.dumps({"a": {1, 2}}, protocol=4),
        pickle.dumps(pickle.PickleBuffer(b"x"), protocol=5),
    ],
)
def test_reading_a_pickle_never_fails_otherwise(data):
    """Nor does it run anything: whatever is no tensor stays a name."""
    try:
        pickles.read_pickle(data, source="x")
    except PolicyError as error:
        assert len(str(error)) < 200


def test_names_that_no_system_takes(tmp_path):
    for name in ("x" * 300, "a\0b", tmp_path / "loop"):
        if name == tmp_path / "loop":
            name.symlink_to(name)
        with pytest.raises(PolicyError, match=r"cannot be read|there is no policy|null"):
            find_policy(name)


def test_a_long_name_can_be_written(tmp_path, contract, cts_stored):
    path = tmp_path / ("x" * 246 + ".gauge.pt")
    save_policy(path, contract, cts_stored)
    assert load_policy(path).contract == contract
    assert [f.name for f in tmp_path.iterdir()] == [path.name]


def test_words_of_a_file_do_not_act_on_the_terminal(tmp_path, contract, cts_stored, cts_file):
    entries = torch.load(cts_file, weights_only=True)
    entries["network"]["architecture"] = "nose\x1b[31m\u202e" + "x" * 5000
    entries["contract"] = replace(contract).to_json()
    torch.save({**entries, "checksum": checksum(entries)}, cts_file)
    message = refused(cts_file, "nose")
    assert "\\x1b" in message and "\\u202e" in message and message.isprintable()
    assert len(message) < LONGEST_MESSAGE + 200


def test_the_shipped_policy_and_a_buffer_are_read_the_same(cts_file):
    """What is put together again holds what the file holds, to the last byte."""
    records = archive.read_archive(cts_file.read_bytes(), source="")
    with zipfile.ZipFile(io.BytesIO(archive.packed(records))) as made:
        assert {n.partition("/")[2]: made.read(n) for n in made.namelist()} == records

import json
import struct

import pytest

from cmedirl_jax.runs.loggers.base import Point
from cmedirl_jax.runs.loggers.wandb import WANDB

pytest.importorskip("wandb", reason="wandb is not installed: it comes with the extra log")
BLOCK, WHOLE, LAST = 2**15, 1, 4


@pytest.fixture(autouse=True)
def in_their_own_folders(tmp_path, monkeypatch):
    """Their files beside a run's lie in this test's folder, and nothing can be sent."""
    for name in ("CACHE", "CONFIG", "DATA"):
        monkeypatch.setenv(f"WANDB_{name}_DIR", str(tmp_path / "home"))
    monkeypatch.setenv("WANDB_MODE", "online")
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")


def stored(path):
    """The records of a run's file, which is a log of LevelDB's: pieces in blocks of 32 KiB."""
    from wandb.proto.wandb_internal_pb2 import Record

    content, place, records, pieces = path.read_bytes(), 7, [], b""
    assert content[:4] == b":W&B"
    while place < len(content):
        if BLOCK - place % BLOCK < 7:
            place += BLOCK - place % BLOCK
            continue
        _, size, kind = struct.unpack("<IHB", content[place : place + 7])
        pieces += content[place + 7 : place + 7 + size]
        place += 7 + size
        if kind in (WHOLE, LAST):
            records.append(Record.FromString(pieces))
            pieces = b""
    return records


def test_series_are_offline_runs_of_one_group_and_nothing_is_printed(tmp_path, capfd):
    folder = tmp_path / "log" / "ddpg-seeds-3-4"
    series = ("mean", "seed-3")
    writers = {name: WANDB.open(folder, name, {"seeds": 2}) for name in series}
    for step in (0, 250):
        for number, writer in enumerate(writers.values()):
            writer.write([Point(step, {"return_mean": step + number + 0.5})])
    for writer in writers.values():
        writer.close()

    found = {}
    for path in (folder / "wandb").glob("offline-run-*/run-*.wandb"):
        records = stored(path)
        (run,) = (record.run for record in records if record.HasField("run"))
        assert (run.run_group, run.project) == (folder.name, "cmedirl_jax")
        assert {x.key: json.loads(x.value_json) for x in run.config.update}["seeds"] == 2
        history = [record.history.item for record in records if record.HasField("history")]
        found[run.display_name] = [
            {x.key or x.nested_key[0]: json.loads(x.value_json) for x in items} for items in history
        ]
    for number, name in enumerate(series):
        rows = [(row["_step"], row["return_mean"]) for row in found.pop(name)]
        assert rows == [(0, number + 0.5), (250, 250 + number + 0.5)]
    assert not found
    assert capfd.readouterr() == ("", "")

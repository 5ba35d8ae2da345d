"""Commands: what they cannot do is refused in one line; ``compare`` pairs policies by seed, on anybody's channel."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from edge_server.cli import main
from edge_server.experiments import compare_command
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.channels import read_channel
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from freshfield.scenario import ScenarioError, load
from tests.edge_server.experiments.rollouts.small import RAW
from tests.edge_server.experiments.sets import SMALL_WORDS, write_photos
from tests.support import refusal, refused


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("compare SMALL hope", "hope"),
        ("compare SMALL all --channel sms", "sms"),
        ("compare SMALL all --seconds inf", "--seconds inf: expected more than 0"),
        ("compare SMALL all --seconds 0.005", "--seconds 0.005: expected at least 0.01"),
        ("costs SMALL --seconds nan", "--seconds nan: expected more than 0"),
        ("compare nowhere all", "shipped scenarios"),
        ("fit SET --option levels", "expected KEY=VALUE"),
        ("fit SET --resume", "no fit to go on from"),
        ("fit tile --scale 0", "--scale 0: expected more than 0"),
        ("frontier --scene nowhere", "no such file or folder"),
        ("frontier --field splot", "field 'splot' is not known (did you mean splat?); there are: ngp"),
        ("run room --seconds=nan", "expected 0 to 1e+09"),
        ("run room --checkpoint-every=1e300", "expected 0 to 1e+09"),
        ("simulate SMALL --compute=-1:0", "--compute"),
        ("simulate SMALL --seconds 0", "--seconds"),
        ("study mat --jobs 0", "--jobs: expected at least 1"),
        ("study mat --scene cell", "its camera moves"),
        ("study ppo-wait --scene tower", "scenes of its own"),
        ("train-scheduler room --parts age,smell", "no part is called smell"),
        ("train-scheduler room --omegas 20,60", "select takes none"),
        ("train-scheduler room --size -5", "--size.width: expected a whole number, 8 to 4096, got -5"),
        ("train-scheduler room --kind wait --omegas 20,soon", "expected milliseconds such as"),
        ("viewpoints tile --budget many", "expected views"),
        ("viewpoints tile --budget 8,9", "expected views"),
        ("viewpoints tile --budget 4 --travel nan", "--travel nan: expected 0 or more"),
        ("viewpoints tile --budget 4 --selector ppo:none.npz", "not a viewpoint policy"),
        ("viewpoints tower --budget 4", "its cameras look outward"),
        ("viewpoints tile --budget 1 --ask edges", "at least 2 views"),
        ("viewpoints tile --budget 4 --ask --insecure --page-host 192.0.2.1", "192.0.2.1:8080; choose"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(words: str, said: str, tmp_path, capsys) -> None:
    """SMALL: a scenario, SET: a data set."""
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(RAW))
    if "SET" in words:
        write_photos(tmp_path / "set", 3)
    quick = {"fit": SMALL_WORDS, "frontier": ["--quick"], "study": ["--quick"]}
    places = {"SMALL": str(tmp_path / "small.yaml"), "SET": str(tmp_path / "set")}
    command, *given = [places.get(word, word) for word in words.split()]
    out = tmp_path / "out"
    written = ["--out", str(out)]
    if command == "compare":  # results: a line for each run
        written = ["--json", str(out / "scores.json"), "--results", str(out / "results.jsonl")]
    assert said in refusal(capsys, main, command, *quick.get(command, []), *given, *written)
    assert not out.is_file() and not any(path.is_file() and path.stat().st_size for path in out.rglob("*"))


def test_a_channel_is_a_preset_a_scenario_or_a_section_alone(tmp_path: Path):
    assert read_channel("ch5") == ({"preset": "ch5"}, "ch5")
    (tmp_path / "delays.txt").write_text("10\n20\n")
    section = {"service": "trace:delays.txt", "discipline": "fcfs"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(section))
    found, name = read_channel(str(tmp_path / "mine.yaml"))
    assert name == "mine" and found["service"] == f"trace:{tmp_path / 'delays.txt'}"
    (tmp_path / "whole.yaml").write_text(yaml.safe_dump({**RAW, "channel": section}))
    source = {"data": "mine.yaml", "trajectory": {"files": {"cam00": "poses.tum"}, "hand_eye": ""}}
    recorded = replace(load(str(tmp_path / "whole.yaml")), source=source, edge={"embedding": {"model": "yolo.onnx"}})
    named = [tmp_path / name for name in ("mine.yaml", "delays.txt", "poses.tum", "yolo.onnx")]
    for file in named[2:]:
        file.write_bytes(b"")
    far = replace(recorded, source={**source, "data": "far"})  # a video's poses lie beside its calibration
    (tmp_path / "sets" / "far").mkdir(parents=True)
    (tmp_path / "poses.tum").rename(tmp_path / "sets" / "far" / "poses.tum")
    assert tmp_path / "sets" / "far" / "poses.tum" in Folders(tmp_path / "sets").files_of(far)
    (tmp_path / "poses.tum").write_bytes(b"")
    for data in (tmp_path, None):  # data beside the scenario need no folder
        assert Folders(data).files_of(recorded) == named
    listed = [tmp_path / name for name in ("transforms_train.json", "transforms_test.json", "a.png", "b.png")]
    for file, image in zip(listed, ("a", "./b.png")):
        file.write_text(json.dumps({"frames": [{"file_path": image}]}))
        (tmp_path / image).with_suffix(".png").write_bytes(b"")
    assert set(listed) < set(Folders().files_of(replace(recorded, source={"data": listed[0].name})))
    assert read_channel(str(tmp_path / "whole.yaml"))[0] == found
    (tmp_path / "wrong.yaml").write_text("{discipline: sometimes}")
    for text in (str(tmp_path / "wrong.yaml"), str(tmp_path / "none.yaml"), "sms"):
        refused(ScenarioError, "--channel", read_channel, text)


def test_a_star_marks_what_is_decided_and_not_what_is_equal():
    gained = {"all": [0.0] * 6, "the same": [0.0] * 6, "better": [2.0, 2.1, 1.9, 2.0, 2.2, 1.8]}
    rows = [{"policy": p, "seed": k, "psnr_db": 20.0 + g} for p, of in gained.items() for k, g in enumerate(of)]
    starred = [line for line in compare_command.as_text(SeedTable(rows), list(gained)).splitlines() if "*" in line]
    assert len(starred) == 1 and starred[0].startswith("better") and starred[0].count("*") == 1


def test_the_command_compares_and_goes_on(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(tuned, "COMPARE_LEAD_S", 0.6)
    edge = {**RAW["edge"], "steps": 2, "updates": "arrivals", "update_ms": 50, "compute": {"ms_per_step": 2.0}}
    scenario, out = tmp_path / "small.yaml", tmp_path / "scores.json"
    scenario.write_text(yaml.safe_dump({**RAW, "edge": edge}))
    words = [str(scenario), "all", "freshest-k:2", "wait:60000", "--seeds", "2", "--seconds", "0.5", "--jobs", "1"]
    words += ["--json", str(out), "--results", str(tmp_path / "known.jsonl"), "--channel", "ch6-slow"]
    monkeypatch.setattr("edge_server.embed.make_embedder", lambda _: pytest.fail("no policy looks at embeddings"))
    assert compare_command.main(words) == 0
    printed = capsys.readouterr().out
    assert "freshest-k:2" in printed and "minus all" in printed and "after the lead: wait:60000\n" in printed
    found = json.loads(out.read_text())
    assert found["channel"] == {"preset": "ch6-slow"} and found["compute"]["ms_per_step"] == 2.0
    assert found["policies"]["freshest-k:2"]["views"][0] <= 2.0
    everything, fresh = (found["policies"][name] for name in ("all", "freshest-k:2"))
    assert everything["psnr_db"][0] > 5.0 and everything["psnr_db_over_all"] == [0.0, 0.0, 0.0]
    assert fresh["psnr_db_over_all"][0] == pytest.approx(fresh["psnr_db"][0] - everything["psnr_db"][0])
    known = (tmp_path / "known.jsonl").read_bytes()
    assert compare_command.main(words) == 0 and (tmp_path / "known.jsonl").read_bytes() == known

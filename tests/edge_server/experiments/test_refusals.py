"""What a command cannot do is refused in one line, with exit status 2, and nothing is written."""

from __future__ import annotations

import pytest
import yaml

from edge_server.cli import main
from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.fitting import fit
from edge_server.experiments.virtual import simulate
from freshfield.scenario import ScenarioError
from tests.edge_server.experiments.rollouts.small import RAW
from tests.edge_server.experiments.sets import SMALL_WORDS, write_photos

# Of each command, words that it cannot work with, and what it says. SMALL: a scenario, SET: a data set.
REFUSED = {
    "compare": [("SMALL hope", "hope"), ("SMALL all --channel sms", "sms"), ("nowhere all", "shipped scenarios")],
    "fit": [
        ("SET --option levels", "expected KEY=VALUE"),
        ("SET --option color=1", "no option color"),
        ("SET --scale 0.5", "scale is 0.5"),
        ("SET --resume", "no fit to go on from"),
        ("tile --scale 0", "--scale 0: expected more than 0"),
        ("tile --holdout 0", "--holdout is for data sets; the scene tile holds out cam00"),
        ("tile --format colmap", "--format is for data sets"),
    ],
    "frontier": [
        ("--scene nowhere", "no such file or folder"),
        ("--field splot", "field 'splot' is not known (did you mean splat?); there are: ngp"),
        ("--field ngp --option levels=99", "levels: expected a whole number"),
    ],
    "simulate": [
        ("SMALL --compute=-1:0", "--compute"),
        ("SMALL --policy wait:1e308", "omega_ms: expected 0 to 3600000, got 1e+308"),
        ("SMALL --seconds 0", "--seconds"),
    ],
    "study": [
        ("mat --jobs 0", "--jobs: expected at least 1"),
        ("mat --scene cell", "its camera moves"),
        ("metrics --channel ch5", "--channel is for mat"),
        ("ppo-wait --scene tower", "scenes of its own"),
        ("mat --case room", "--case is for ppo-select"),
        ("ppo-wait --case ch7", "none has 'ch7' in its name"),
    ],
    "train-scheduler": [
        ("room --parts age,smell", "no smell"),
        ("room --omegas 20,60", "--kind select chooses cameras"),
        ("room --kind wait --omegas 20,soon", "expected milliseconds such as"),
        ("room --price -1", "--price: expected 0 or more"),
    ],
    "viewpoints": [
        ("tile --budget many", "expected views"),
        ("tile --budget 4 --selector best", "selector 'best' is not known; there are: random"),
        ("tile --budget 4 --selector ppo:none.npz", "not a viewpoint policy"),
        ("tower --budget 4", "its cameras look outward"),
    ],
}
QUICK = {"fit": SMALL_WORDS, "frontier": ["--quick"], "study": ["--quick"]}


@pytest.mark.parametrize(
    ("command", "words", "said"), [(command, *row) for command, rows in REFUSED.items() for row in rows]
)
def test_what_cannot_be_done_is_refused_in_one_line(command: str, words: str, said: str, tmp_path, capsys) -> None:
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(RAW))
    if "SET" in words:
        write_photos(tmp_path / "set", 3)
    places = {"SMALL": str(tmp_path / "small.yaml"), "SET": str(tmp_path / "set")}
    given = [places.get(word, word) for word in words.split()]
    out = tmp_path / "out"
    written = ["--out", str(out)]
    if command == "compare":  # results: a line for each run
        written = ["--json", str(out / "scores.json"), "--results", str(out / "results.jsonl")]
    assert main([command, *QUICK.get(command, []), *given, *written]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not out.is_file() and not any(path.is_file() and path.stat().st_size for path in out.rglob("*"))


@pytest.mark.parametrize("check", [fit.check_seconds, simulate.check_seconds])
def test_a_time_is_more_than_nothing_and_at_most_a_million_seconds(check):
    check(1e-9)
    check(1e6)
    for seconds in (0.0, -1.0, 1e6 + 0.5, float("nan"), float("inf")):
        with pytest.raises((OptionError, ScenarioError), match="more than 0 and at most 1e6"):
            check(seconds)

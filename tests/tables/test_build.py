"""What stands in the tables: means, deviations, bold, failed seeds, notes; golden tables."""

from __future__ import annotations

import json
import math
import statistics
from pathlib import Path

import pytest

from apex_lab.tables.build import Built
from apex_lab.tables.markdown import table_text
from apex_lab.tables.rows import rounded, summarise
from tests.tables.folders import SCORES, job, line, made, run_folder


def only(outputs: Path, number: int = 1, **asked: object) -> Built:
    tables, _ = made(outputs, tables=(number,), **asked)
    return tables[0]


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_deviation_is_that_of_a_sample(count: int) -> None:
    values = [0.1, 0.4, 0.35, 0.9][:count]
    found = summarise(values)
    assert found.n == count
    assert found.mean == pytest.approx(statistics.fmean(values), rel=1e-15)
    assert found.std == pytest.approx(statistics.stdev(values), rel=1e-14)
    assert found.std != pytest.approx(statistics.pstdev(values), rel=0.05)


def test_undefined_values_are_never_in_a_mean() -> None:
    found = summarise([1.0, math.nan, 3.0, math.inf])
    assert (found.n, found.mean, found.std) == (2, 2.0, pytest.approx(math.sqrt(2)))
    assert summarise([math.nan, 3.0]).std is None
    nothing = summarise([math.nan])
    assert nothing.n == 0
    assert math.isnan(nothing.mean)


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (-0.004, 2, "0.00"),
        (-0.0, 1, "0.0"),
        (-0.04, 1, "0.0"),
        (-0.06, 1, "-0.1"),
        (0.875, 2, "0.88"),
        (0.895, 2, "0.90"),  # binary 0.895000000000000017...
        (0.885, 2, "0.89"),
        (-125.55, 1, "-125.5"),  # binary -125.5499999...
        (99.96, 1, "100.0"),
    ],
)
def test_rounding_once_and_no_negative_zero(value: float, decimals: int, text: str) -> None:
    assert rounded(value, decimals) == text


def test_rounding_is_of_the_unrounded_mean(tmp_path: Path) -> None:
    for seed, value in enumerate((0.444, 0.444, 0.449, 0.4451)):  # rounded first: mean of .44 .44 .45 .45 = .445
        run_folder(tmp_path, "apex", seed, {"ari": value})
    cell = only(tmp_path).lines[-1].cells["ari"]
    assert cell.summary is not None
    assert rounded(cell.summary.mean, 2) == "0.45"
    assert cell.summary.mean == pytest.approx(0.445525)


def test_golden_segmentation(tmp_path: Path) -> None:
    for seed in range(3):
        run_folder(tmp_path, "scalor", seed, {"ari_fg": 0.3 + 0.05 * seed, "msc": 0.704})
    run_folder(tmp_path, "space", 2)
    text = table_text(only(tmp_path, published=True), published=True)
    rows = [[entry.strip() for entry in row.split("|")[1:-1]] for row in text.splitlines() if row.startswith("|")]
    assert rows[0] == ["", "Object tracking", "ARI-FG", "MSC-FG", "ARI", "MSC", "Seeds"]
    published = ["0.30 ± 0.03", "0.30 ± 0.01", "0.15 ± 0.05", "0.39 ± 0.03"]
    assert rows[2] == ["OP3", "✓", *(f"— ({value})" for value in published), "0 of 4"]
    assert rows[3] == [
        "SCALOR",
        "✓",
        "0.35 ± 0.05 (0.31 ± 0.03)",
        "**0.40 ± 0.00** (0.37 ± 0.01)",
        "**0.60 ± 0.00** (0.43 ± 0.04)",
        "**0.70 ± 0.00** (0.52 ± 0.01)",
        "3 of 4",
    ]
    assert [row[:2] for row in rows[4:]] == [["G-SWM\\*", "✓"], ["SPACE", "✗"], ["Slot-Att.", "✗"], ["APEX", "✓"]]
    assert rows[5][2:] == [
        "**0.50** (0.33 ± 0.17)",
        "**0.40** (0.49 ± 0.12)",
        "**0.60** (0.72 ± 0.21)",
        "**0.70** (0.62 ± 0.09)",
        "1 of 4",
    ]


def test_golden_small_tables(tmp_path: Path) -> None:
    for seed, value in enumerate((0.88, 0.91, 0.90, 0.87)):
        run_folder(tmp_path, "apex", seed, {"ari_fg": value, "msc_fg": 0.5, "ari": -0.001 * seed, "msc": 0.7})
    run_folder(tmp_path, "apex", 2, {"ari_fg": 0.95}, ablation="image_stn")
    run_folder(tmp_path, "apex", 0, {"ari_fg": 0.99}, ablation="gaussian")
    golden = (Path(__file__).parent / "golden" / "table_3.md").read_text(encoding="utf-8")
    assert table_text(only(tmp_path, 3), published=False) + "\n" == golden


def test_golden_tracking_with_the_paper_s_values(tmp_path: Path) -> None:
    for seed in range(2):
        run_folder(tmp_path, "apex", seed, {"mota": 50.0 + seed, "motp": None, "md": 70.0, "mt": 69.96})
    text = table_text(only(tmp_path, 2, published=True), published=True)
    apex = next(row for row in text.splitlines() if row.startswith("| APEX"))
    assert [entry.strip() for entry in apex.split("|")[2:-1]] == [
        "**50.5 ± 0.7** (50.5 ± 4.0)",
        "n/a (83.2 ± 0.6)",
        "**60.0 ± 0.0** (79.7 ± 0.5)",
        "**1.0 ± 0.0** (0.2 ± 0.1)",
        "**20.0 ± 0.0** (29.2 ± 3.8)",
        "**39.0 ± 0.0** (20.0 ± 0.5)",
        "**70.0 ± 0.0** (71.2 ± 0.7)",  # the paper prints 71.2 under MT
        "**70.0 ± 0.0** (70.8 ± 1.0)",
        "2 of 4",
    ]
    head = next(row for row in text.splitlines() if row.startswith("|  "))
    assert [entry.strip() for entry in head.split("|")[2:-1]] == [
        *("MOTA ↑", "MOTP ↑", "Match ↑", "ID S. ↓", "FPs ↓", "Miss ↓", "MD ↑", "MT ↑", "Seeds")
    ]
    assert "headings MD and MT are evidently exchanged" in text
    assert "- APEX: MOTP is undefined (n/a) in seed 0 and 1 and left out of the mean there." in text


def test_the_public_protocol_stands_beside(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, {"mota": 10.0, "mota_start2": 20.0})
    tables, _ = made(tmp_path, tables=(2,), published=True)
    assert [table.number for table in tables] == ["2", "2b"]
    cells = [line(tables[0], "APEX").cells["mota"], line(tables[1], "APEX").cells["mota_start2"]]
    assert [cell.summary.mean for cell in cells if cell.summary] == [10.0, 20.0]
    assert [cell.published for cell in cells] == [(50.5, 4.0)] * 2
    assert line(tables[1], "APEX").cells["md_start2"].published == (71.2, 0.7)


def test_bold_goes_to_all_that_are_equal_as_printed(tmp_path: Path) -> None:
    run_folder(tmp_path, "op3", 0, {"ari": 0.8849, "fps": 3.04})
    run_folder(tmp_path, "scalor", 0, {"ari": 0.8751, "fps": 2.96})
    run_folder(tmp_path, "apex", 0, {"ari": 0.8749, "fps": 3.06})
    assert [each.label for each in only(tmp_path).lines if each.cells["ari"].best] == ["OP3", "SCALOR"]
    assert [each.label for each in only(tmp_path, 2).lines if each.cells["fps"].best] == ["OP3", "SCALOR"]


def test_a_negative_zero_ties_with_zero(tmp_path: Path) -> None:
    run_folder(tmp_path, "op3", 0, {"ari": -0.004})
    run_folder(tmp_path, "apex", 0, {"ari": 0.004})
    text = table_text(only(tmp_path), published=False)
    assert text.count("**0.00**") == 2
    assert "-0.00" not in text


def test_undefined_values_and_yardsticks_never_win(tmp_path: Path) -> None:
    run_folder(tmp_path, "op3", 0, {"motp": None})
    run_folder(tmp_path, "apex", 0, {"motp": 55.0})
    run_folder(tmp_path, "oracle", 0, {"motp": 100.0})
    table = only(tmp_path, 2, yardsticks=True)
    assert [each.label for each in table.lines if each.cells["motp"].best] == ["APEX"]


def test_a_missing_score_is_missing_and_told(tmp_path: Path) -> None:
    for seed in range(2):
        run_folder(tmp_path, "apex", seed, {"ari": "absent" if seed else 0.3, "msc": "absent"})
    table = only(tmp_path)
    found = line(table, "APEX")
    assert found.cells["msc"].summary is None
    assert found.cells["ari"].summary == summarise([0.3])
    assert found.notes == (
        "the results of seed 1 have no ARI (ari).",
        "the results of seed 0 and 1 have no MSC (msc).",
    )


def failing(outputs: Path, model: str) -> None:
    """Seeds 0 and 1 are well, seed 2 gives all pixels to objects, seed 3 diverged."""
    run_folder(outputs, model, 0, {"ari": 0.5}, foreground_share=0.2)
    run_folder(outputs, model, 1, {"ari": 0.7}, foreground_share=0.2)
    run_folder(outputs, model, 2, {"ari": 0.0}, foreground_share=1.0)
    run_folder(outputs, model, 3, status="failed", reason="train/loss is nan at step 9 (not finite: train/loss): try.")


def test_failed_seeds_of_a_listed_model_are_left_out_and_counted_in_the_footnote(tmp_path: Path) -> None:
    failing(tmp_path, "gswm")
    for number in (1, 2):
        table = only(tmp_path, number, published=True)
        found = line(table, "G-SWM")
        assert (found.counted, sorted(found.excluded), found.seeds) == ((0, 1), [2, 3], "2 of 4")
        assert table.footnotes == (
            "* The G-SWM results are computed with two failed random seeds being excluded "
            "(seed 2: it gives 100.000 % of the validation pixels to objects; seed 3: its loss was not finite). "
            "The paper excludes one failed random seed.",
        )
    cell = line(only(tmp_path), "G-SWM").cells["ari"]
    assert cell.summary == summarise([0.5, 0.7])
    assert cell.over_all == summarise([0.5, 0.7, 0.0])
    assert dict(cell.values) == {0: (0.5,), 1: (0.7,), 2: (0.0,)}


def test_one_failed_seed_is_told_in_the_paper_s_words(tmp_path: Path) -> None:
    for seed in range(4):
        run_folder(tmp_path, "gswm", seed, foreground_share=0.0 if seed == 1 else 0.3)
    (note,) = only(tmp_path).footnotes
    assert note.startswith("* The G-SWM results are computed with one failed random seed being excluded (seed 1:")
    assert "paper" not in note


def test_without_failed_seeds_there_is_no_asterisk_but_the_paper_s(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, foreground_share=0.3)
    assert only(tmp_path).footnotes == ()
    assert not line(only(tmp_path), "G-SWM").asterisk
    assert only(tmp_path, published=True).footnotes == (
        "* The paper's G-SWM results are computed with one failed random seed being excluded; ours with none.",
    )


def test_failed_seeds_of_other_models_count_and_are_told(tmp_path: Path) -> None:
    failing(tmp_path, "scalor")
    found = line(only(tmp_path), "SCALOR")
    assert (found.counted, found.excluded, sorted(found.failed), found.seeds) == ((0, 1, 2), {}, [3], "3 of 4")
    assert found.cells["ari"].summary == summarise([0.5, 0.7, 0.0])
    assert found.notes[0].startswith("seed 3 failed: its loss was not finite; its last word is: train/loss is nan")
    assert found.notes[1] == (
        "seed 2 failed by the failed-seed rule (it gives 100.000 % of the validation pixels to objects) and counts all "
        "the same, since exclude_failed does not list this model."
    )


def test_any_model_can_be_listed(tmp_path: Path) -> None:
    failing(tmp_path, "scalor")
    found = line(only(tmp_path, exclude_failed=("scalor",)), "SCALOR")
    assert (found.counted, sorted(found.excluded)) == ((0, 1), [2, 3])


def test_a_seed_that_the_rule_cannot_judge_is_told(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0)
    assert line(only(tmp_path), "G-SWM").notes == (
        "run.json of seed 0 has no foreground_share, so the failed-seed rule saw the loss alone: "
        "evaluate with split=val.",
    )


def test_when_all_seeds_failed_the_row_is_empty_and_says_why(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, foreground_share=0.0)
    table = only(tmp_path)
    found = line(table, "G-SWM")
    assert found.cells["ari"].summary is None
    assert found.notes == ("seed 0 failed: it gives 0.000 % of the validation pixels to objects",)
    assert table.footnotes == ()


def test_damaged_and_unfinished_seeds_are_shown(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0)
    file = run_folder(tmp_path, "apex", 1) / "metrics.json"
    file.write_text('{"splits"')
    run_folder(tmp_path, "apex", 2, status="running")
    found = line(only(tmp_path), "APEX")
    assert (found.counted, sorted(found.failed), sorted(found.unfinished), found.missing) == ((0,), [1], [2], (3,))
    assert found.notes[0].startswith(f"seed 1 failed: {file} cannot be read")
    assert found.notes[1] == "seed 2 is not finished: its status is 'running'."
    assert found.seeds == "1 of 4"


def test_rows_scored_on_other_videos_do_not_compete(tmp_path: Path) -> None:
    for model in ("op3", "scalor"):
        run_folder(tmp_path, model, 0, {"ari": 0.3})
    run_folder(tmp_path, "apex", 0, {"ari": 0.9}, data_fingerprint="e" * 32)
    table = only(tmp_path)
    assert "fingerprint dddddddd" in table.caption
    assert not line(table, "APEX").cells["ari"].best
    assert line(table, "OP3").cells["ari"].best
    assert line(table, "APEX").notes == (
        "scored on other data (fingerprint eeeeeeee) than most rows: not comparable, not a candidate for bold.",
    )


def test_only_the_seeds_of_the_jobs_count(tmp_path: Path) -> None:
    for seed in (0, 1, 2, 3, 8):
        run_folder(tmp_path, "apex", seed, {"ari": 0.1 * seed})
    found = line(only(tmp_path, seeds=(0, 8)), "APEX")
    assert (found.seeds, found.counted, found.missing) == ("2", (0, 8), ())
    assert found.cells["ari"].summary == summarise([0.0, 0.8])


PERFECT = dict.fromkeys(("ari_fg", "msc_fg", "ari", "msc"), 1.0) | {
    key: 0.0 if key in ("id_switches", "fps", "misses") else 100.0
    for key in ("mota", "motp", "match", "id_switches", "fps", "misses", "md", "mt")
}


def test_yardsticks_stand_below_and_test_the_evaluation(tmp_path: Path) -> None:
    run_folder(tmp_path, "oracle", 0, PERFECT)
    run_folder(tmp_path, "one_segment", 0, {"ari": 0.0})
    for number in (1, 2, 3):
        table = only(tmp_path, number, yardsticks=True, published=True)
        labels = [each.label for each in table.lines][-4:]
        assert labels == ["Colour clusters", "Background subtraction", "Oracle", "One segment"]
        assert [each.seeds for each in table.lines][-4:] == ["0 of 1", "0 of 1", "1", "1"]
        assert all(cell.published is None for each in table.lines[-4:] for cell in each.cells.values())
        assert not any(each.notes for each in table.lines[-4:])
    four = only(tmp_path, 4, yardsticks=True)
    assert [each.name for each in four.lines][:4] == ["SPACE", "SCALOR", "G-SWM", "APEX"]
    assert len(four.lines) == 8


def test_an_oracle_that_is_not_perfect_is_told(tmp_path: Path) -> None:
    run_folder(tmp_path, "oracle", 0, PERFECT | {"ari": 0.99, "motp": None})
    found = line(only(tmp_path, 1, yardsticks=True), "Oracle")
    assert found.notes == ("ARI must be 1 and is 0.99: do not trust this evaluation.",)
    assert "MOTP must be 100 and is nan" in line(only(tmp_path, 2, yardsticks=True), "Oracle").notes[-1]


def test_frames_without_objects_excuse_the_oracle(tmp_path: Path) -> None:
    run_folder(tmp_path, "oracle", 0, PERFECT | {"msc_fg": 0.9, "empty_frames": 3})
    assert line(only(tmp_path, yardsticks=True), "Oracle").notes == ()


SCENARIOS = {"2": [[0.0, 0.2], [1.0, 0.4], [0.1, 0.1]], "3": [[0.3, 0.3, 0.3]], "4": []}


def test_arrangement_is_over_scenarios_or_objects(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    (folder / "arrangement.json").write_text(json.dumps({"distances_m": SCENARIOS}))
    for seed in (1, 2):
        run_folder(tmp_path, "apex", seed)
    found = line(only(tmp_path, 4), "APEX")
    assert (found.counted, found.seeds, found.missing) == ((0,), "1", ())
    two = found.cells["2"].summary
    assert two is not None
    assert (two.n, two.mean, two.std) == (3, pytest.approx(0.3), pytest.approx(statistics.stdev([0.1, 0.7, 0.1])))
    assert found.cells["3"].summary == summarise([statistics.fmean([0.3, 0.3, 0.3])])
    text = table_text(only(tmp_path, 4), published=False)
    row = next(row for row in text.splitlines() if row.startswith("| APEX"))
    assert [entry.strip() for entry in row.split("|")[2:-1]] == ["**0.30 ± 0.35**", "**0.30**", "n/a", "1"]
    pooled = line(only(tmp_path, 4, arrangement_mean="object"), "APEX").cells["2"].summary
    assert pooled is not None
    assert (pooled.n, pooled.std) == (6, pytest.approx(statistics.stdev([0.0, 0.2, 1.0, 0.4, 0.1, 0.1])))


def test_arrangement_pools_the_scenarios_of_all_seeds(tmp_path: Path) -> None:
    for seed, value in enumerate((0.1, 0.3)):
        folder = run_folder(tmp_path, "apex", seed)
        (folder / "arrangement.json").write_text(json.dumps({"distances_m": {"2": [[value, value]] * 2}}))
    found = line(only(tmp_path, 4), "APEX")
    assert found.cells["2"].summary == summarise([0.1, 0.1, 0.3, 0.3])
    assert found.seeds == "2"


def test_damaged_arrangement_is_shown(tmp_path: Path) -> None:
    file = run_folder(tmp_path, "apex", 0) / "arrangement.json"
    file.write_text("{")
    found = line(only(tmp_path, 4), "APEX")
    assert found.notes[0].startswith(f"seed 0 failed: {file} cannot be read")
    assert line(only(tmp_path, 1), "APEX").counted == (0,)


def test_other_scales_are_not_mixed_in(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, {"ari": 0.1})
    run_folder(tmp_path, "apex", 0, {"ari": 0.9}, scale="cpu")
    tables, _ = made(tmp_path, scale="cpu", published=True)
    cell = line(tables[0], "APEX").cells["ari"]
    assert cell.summary == summarise([0.9])
    assert "scale cpu (not the paper's scale)" in tables[0].caption
    assert "of scale paper and cannot be compared with scale cpu" in tables[0].caption
    assert {each.label for each in tables[0].lines} >= {"APEX, scale=cpu", "OP3, scale=cpu"}


def test_rows_say_what_differs_from_the_paper(tmp_path: Path) -> None:
    mixed = [
        job(tmp_path, "apex", 0),
        job(tmp_path, "apex", 0, data="sprites"),
        job(tmp_path, "apex", 0, scale="cpu", words=("+tuned=sigma", "model/apex/likelihood=gaussian")),
        job(tmp_path, "mine", 0),
        job(tmp_path, "apex", 0, "my_ablation"),
    ]
    for each in mixed:
        named = {group: each.choices.get(group) for group in ("ablation", "data", "scale")}
        scores = {"ari": 0.8, **({"mota": None} if each.choices["model"] == "mine" else {})}
        run_folder(tmp_path, each.choices["model"], 0, scores, **named)
    table = only(tmp_path, jobs=[each.again() for each in mixed], published=True)
    assert [(each.label, each.tracking) for each in table.lines] == [
        ("APEX", True),
        ("APEX, data=sprites", True),
        ("APEX, scale=cpu, tuned=sigma, likelihood=gaussian", True),
        ("mine", False),
        ("APEX, ablation=my_ablation", True),
    ]
    assert [block.title for block in table.blocks] == [None, "Not in the paper"]
    assert [each.cells["ari"].published for each in table.lines] == [(0.93, 0.0), None, (0.93, 0.0), None, None]
    assert "Data p2d and sprites, scale paper and cpu (not the paper's scale: cpu)" in table.caption
    assert "Bold: best of all models but the yardsticks" in table.caption


def test_rows_that_were_not_asked_for_are_not_there(tmp_path: Path) -> None:
    table = only(tmp_path, jobs=[job(tmp_path, "apex", 0), job(tmp_path, "oracle", 0)], yardsticks=True)
    assert [each.label for each in table.lines] == ["APEX", "Oracle"]
    assert [block.title for block in table.blocks] == [None, "Tests of the evaluation"]


def test_what_the_paper_says_of_its_data_is_said_of_no_other(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "apex", 0, "gaussian", data="sprites"), job(tmp_path, "gswm", 0, data="sprites")]
    for number in (3, 1):
        table = only(tmp_path, number, jobs=jobs, published=True)
        assert table.footnotes == ()
        assert not any(each.asterisk for each in table.lines)


def test_the_scores_of_the_hand_made_runs_obey_the_identities() -> None:
    assert SCORES["match"] - SCORES["fps"] == SCORES["mota"]
    assert SCORES["match"] + SCORES["id_switches"] + SCORES["misses"] == 100


def test_a_table_shows_runs_of_its_own_data_where_runs_for_several_tables_are_asked_for(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0, data="arrangement")
    tasks = {"2": {"objects": 6, "failures": {"fell": 2, "wrong match": 1}}, "3": {"objects": 3, "failures": {}}}
    (folder / "arrangement.json").write_text(json.dumps({"distances_m": SCENARIOS, "tasks": tasks}))
    run_folder(tmp_path, "apex", 0)
    both = [job(tmp_path, "apex", 0), job(tmp_path, "apex", 0, data="arrangement")]
    tables, found = made(tmp_path, tables=(1, 4), jobs=both, published=True)
    one, four = (next(table for table in tables if table.number == number) for number in ("1", "4"))
    assert [(each.label, each.configuration.data) for each in one.lines] == [("APEX", "p2d")]
    assert [(each.label, each.configuration.data) for each in four.lines] == [("APEX", "arrangement")]
    assert four.lines[0].cells["2"].published == (0.04, 0.10)
    assert "In parentheses: the paper's values" in four.caption
    assert four.lines[0].notes[-1] == (
        "objects away from their goals, seed 0: 3 of 6 with 2 objects (fell 2, wrong match 1); 0 of 3 with 3 objects."
    )
    assert found == ()
    (alone,) = made(tmp_path, tables=(4,), jobs=both[:1], published=True)[0]
    assert [each.label for each in alone.lines] == ["APEX, data=p2d"]
    assert alone.lines[0].cells["2"].published is None

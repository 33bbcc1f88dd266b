"""Translated logs, maps, rules and absences agree with the source and homes.toml, and tables have the right numbers in the right places.

    python -m pytest benches/homes

The homes' data are not part of the project: ROOMCAST_HOMES names their folder for the test that reads them.
"""

import json
import os
import sys
from datetime import date
from pathlib import Path

import pytest

tomllib = pytest.importorskip("tomllib", reason="needs Python 3.11")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import tables
import translate

HOMES = translate.homes()
HOME = {
    "about": "a made-up home",
    "files": "houseX",
    "away": ["leave-house"],
    "doors": [["kitchen", "bed room"]],
    "room": {"kitchen": [0.0, 0.0, 4.0, 3.0], "bed room": [4.0, 1.0, 7.0, 5.0]},
    "sensor": {
        "Kitchen,Cabinet": ["kitchen", "opened", "kitchen cabinet"],
        "Fridge": ["kitchen", "opened", "fridge"],
        "PIR keuken": ["kitchen", "passed", "kitchen"],
        "mat bed": ["bed room", "bed", "bed"],
    },
}
NAMES = "1\tKitchen,Cabinet A\n2\tKitchen,Cabinet B \n3\tmat\tbed\t\n5\tFridge\n6\tPIR keuken"
# 2024-03-01, from 08:00: in bed until then, both cabinets, a sensor without a name, a fridge that stays open.
SENSORS = "1709251200\t28800\t3\n1709280000\t2\t2\n1709280010\t5\t1\n1709280020\t9\t4\n1709280030\t3600\t5\n1709280100\t90\t6\n"
ACTIVITIES = "1709251200\t28800\t10\n1709283600\t7200\t1\n"
ACTIVITY_NAMES = "1\tleave-house\n10\tgo-to-bed"


@pytest.fixture
def translated(tmp_path):
    """Files of a made-up home, and the output of its translation."""
    data, out = tmp_path / "data", tmp_path / "out"
    data.mkdir()
    texts = {"sensors": SENSORS, "sensor_names": NAMES, "activities": ACTIVITIES, "activity_names": ACTIVITY_NAMES}
    for kind, text in texts.items():
        (data / f"houseX.{kind}").write_text(text)
    told = translate.translate(data, out, {"kind": HOMES["kind"], "home": {"X": HOME}})
    return out, told


def test_intervals_have_things_of_one_name_and_are_cut_to_a_minute_but_for_the_bed(translated):
    out, told = translated
    assert (out / "X.tsv").read_text().splitlines() == [
        "Start time\tEnd time\tSensor\tKind\tPlace",
        "2024-03-01 00:00:00\t2024-03-01 08:00:00\tbed\tbed\tbed room",
        "2024-03-01 08:00:00\t2024-03-01 08:00:02\tkitchen cabinet\topened\tkitchen",
        "2024-03-01 08:00:10\t2024-03-01 08:00:15\tkitchen cabinet\topened\tkitchen",
        "2024-03-01 08:00:30\t2024-03-01 08:01:30\tfridge\topened\tkitchen",
        "2024-03-01 08:01:40\t2024-03-01 08:02:40\tkitchen\tpassed\tkitchen",
    ]
    assert told == ["X: 5 intervals; left out, since their sensors have no names: 1"]


def test_an_absence_is_what_the_activity_says(translated):
    lines = (translated[0] / "X-away.tsv").read_text().splitlines()
    assert lines == ["Start time\tEnd time\tActivity", "2024-03-01 09:00:00\t2024-03-01 11:00:00\tleave house"]


def test_rules_say_each_kind_and_do_not_repeat_it_soon(translated):
    rules = {rule["kind"]: rule for rule in tomllib.loads((translated[0] / "rules.toml").read_text())["rule"]}
    assert rules.keys() == HOMES["kind"].keys()
    again_s = {kind: rule["again_s"] for kind, rule in rules.items()}
    assert [again_s.pop(kind) for kind in ("bed", "passed", "shaken")] == [600.0, 300.0, 300.0]
    assert set(again_s.values()) == {30.0}
    assert rules["opened"]["say"] == "They open the {sensor}."


def test_the_map_has_each_thing_once_in_its_room_and_a_door_in_the_wall(translated):
    scene = json.loads((translated[0] / "X-scene.json").read_text())
    assert [(item["id"], item["label"]) for item in scene["items"]] == [
        ("kitchen-cabinet--kitchen", "kitchen cabinet"),
        ("fridge--kitchen", "fridge"),
        ("bed--bed-room", "bed"),
    ]
    assert scene["doors"] == [{"id": "kitchen--bed-room", "rooms": ["kitchen", "bed-room"], "position_m": [4.0, 2.0, 1.0]}]
    with pytest.raises(translate.HomeError, match="share no wall"):
        translate.door({"a": [0.0, 0.0, 1.0, 1.0], "b": [2.0, 0.0, 3.0, 1.0]}, "a", "b")


def test_a_sensor_that_nobody_knows_is_told():
    with pytest.raises(translate.HomeError, match="no sensor is called 'Kettle'"):
        translate.intervals(HOME, HOMES["kind"], [(0, 1, 7)], {7: "Kettle"})


@pytest.mark.parametrize("letter", HOMES["home"])
def test_the_files_of_homes_agree_with_themselves(letter):
    home = HOMES["home"][letter]
    assert len(home["room"]) == {"A": 5, "B": 4, "C": 6, "D": 6, "E": 9}[letter]
    assert {room for room, _, _ in home["sensor"].values()} == home["room"].keys() == {room for door in home["doors"] for room in door}
    assert {kind for _, kind, _ in home["sensor"].values()} <= HOMES["kind"].keys()
    scene = translate.scene(home)
    floors = [(room["box"]["min_m"], room["box"]["max_m"]) for room in scene["rooms"]]
    for at, (low, high) in enumerate(floors):
        for low_2, high_2 in floors[:at]:
            assert any(low[axis] >= high_2[axis] or low_2[axis] >= high[axis] for axis in (0, 1))
    ids = [item["id"] for item in scene["items"]]
    assert len(ids) == len(set(ids))


def test_the_tables_have_what_the_experiment_says():
    def row(predictor, target, nll_nats, day="all"):
        return {"day": day, "predictor": predictor, "target": target, "nll_nats": nll_nats, "top1": 0.5}

    rows = [row(predictor, "room", at) for at, predictor in enumerate(tables.NEXT_ROOM, 1)] + [row("mixture", "room-if-changed", 9.0)]
    rows += [row(predictor, target, 0.25) for predictor in ("mixture", "persistence", "model") for target in tables.AHEAD]
    rows += [row("mixture", "object", 2.0), row("mixture", "object", 3.0, 2), row("mixture", "object", 1.0, 3)]
    less = {"disturbance_s_per_h": -6.6, "disturbance_ci95": [-11.2, 1.7]}
    robots = [("model", 149.6, None), ("mixture", 143.0, less)]
    report = {
        "rows": rows,
        "sets": [{"size_mean": 0.914, "size_mean_shipped": 1.32}],
        "cleaning": [{"predictor": who, "policy": "always-covers", "disturbance_s_per_h": s, "less": less} for who, s, less in robots],
    }
    line = tables.rooms({"X": report}).splitlines()[-1]
    later = "0.25, 0.25, 0.25"
    assert line == f"| X | 1.00, 2.00, 3.00, 4.00 | 50 % | {later} | {later} | {later} | 0.91 of 1.32 | 7 [-2, 11] of 150; - |"
    assert tables.things({"X": report}).splitlines()[-1] == "| X | 2.00, -, -, - | 3.00, -, -, - |"


def test_the_recorded_homes_are_translated_whole(tmp_path):
    folder = os.environ.get("ROOMCAST_HOMES")
    if not folder:
        pytest.skip("ROOMCAST_HOMES names no folder with the recorded homes")
    translate.translate(Path(folder), tmp_path, HOMES)
    for letter, days in {"A": 28, "B": 28, "C": 20, "D": 16, "E": 16}.items():
        lines = [line.split("\t") for line in (tmp_path / f"{letter}.tsv").read_text().splitlines()[1:]]
        first, last = lines[0][0][:10], max(end for _, end, *_ in lines)[:10]
        spoken = {(room, thing) for _, _, thing, _, room in lines}
        assert spoken == {(room, thing) for room, _, thing in HOMES["home"][letter]["sensor"].values()}
        assert (date.fromisoformat(last) - date.fromisoformat(first)).days + 1 == days, letter

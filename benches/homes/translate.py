#!/usr/bin/env python3
"""Translates recorded homes for `roomcast-lab habits --sensors`.

    python benches/homes/translate.py --data FOLDER --out FOLDER

The FOLDER of `--data` has the files house?.sensors, .sensor_names and .activities (README.md names their source). For each home, X.tsv is the
log of its sensors, X-scene.json its map and, if the source has absences, X-away.tsv; rules.toml translates the logs to sentences, for all
homes. homes.toml describes each home. Python 3.11 or newer, standard library only.
"""

import argparse
import json
import math
import re
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
HOMES = HERE / "homes.toml"
HEIGHT_M = 2.5
DOOR_M = 1.0  # above the floor
THING_M = 0.4  # edge of a thing in metres, if the room has enough space


class HomeError(Exception):
    """A home that cannot be translated; the text names the home and the remedy."""


def homes(path: Path = HOMES) -> dict:
    """The file of homes: `kind` has the sentences, `home` has each home."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def time_of(seconds: int) -> str:
    """A time of the source in the format of a log. The source counts its homes' local clocks as if they were UTC."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")


def plain(name: str) -> str:
    """A sensor's name without the letter that numbers things of one kind: "Kitchen,Cabinet" for "Kitchen,Cabinet A"."""
    return re.sub(r" [A-Z]$", "", " ".join(name.split()))


def names(path: Path) -> dict[int, str]:
    """Numbers and names, one per line; a name may contain tabs."""
    lines = (line.split("\t", 1) for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
    return {int(number): name.strip() for number, name in lines}


def events(path: Path) -> list[tuple[int, int, int]]:
    """Per event: start, end and number of the sensor or activity."""
    lines = (map(int, line.split()) for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
    return [(start_s, start_s + length_s, number) for start_s, length_s, number in lines]


def intervals(home: dict, kinds: dict, all_events: list, all_names: dict) -> tuple[list[tuple], int]:
    """Start, end, thing, kind and room of each event, sorted by time; and the number of events without a name."""
    known, unnamed = [], 0
    for start_s, end_s, number in all_events:
        if number not in all_names:
            unnamed += 1
            continue
        name = plain(all_names[number])
        if name not in home["sensor"]:
            raise HomeError(f"{home['about']}: no sensor is called {name!r}; write into homes.toml what it is")
        room, kind, thing = home["sensor"][name]
        longest_s = kinds[kind].get("longest_s", math.inf)
        known.append((start_s, min(end_s, start_s + longest_s), thing, kind, room))
    return sorted(known), unnamed


def absences(home: dict, all_events: list, all_names: dict) -> list[tuple]:
    """Start, end and readable name of each activity during which the home was empty."""
    away = home.get("away", [])
    named = ((start_s, end_s, all_names.get(number)) for start_s, end_s, number in all_events)
    return sorted((start_s, end_s, name.replace("-", " ")) for start_s, end_s, name in named if name in away)


def box(low: list[float], high: list[float]) -> dict:
    return {"min_m": [round(metres, 3) for metres in low], "max_m": [round(metres, 3) for metres in high]}


def id_of(*words: str) -> str:
    return "--".join(word.replace(" ", "-") for word in words)


def door(rooms: dict, one: str, other: str) -> dict:
    """A door in the middle of the wall between two rooms."""
    (west, south, east, north), (west_2, south_2, east_2, north_2) = rooms[one], rooms[other]
    low, high = (max(west, west_2), max(south, south_2)), (min(east, east_2), min(north, north_2))
    sides = [high[0] - low[0], high[1] - low[1]]
    if min(sides) != 0.0 or max(sides) < 0.5:
        raise HomeError(f"{one} and {other} share no wall in which a door could be; move them in homes.toml")
    position_m = [round((low[0] + high[0]) / 2, 3), round((low[1] + high[1]) / 2, 3), DOOR_M]
    return {"id": id_of(one, other), "rooms": [id_of(one), id_of(other)], "position_m": position_m}


def things(room: str, corners: list[float], labels: list[str]) -> list[dict]:
    """The things of a room, in rows and columns on its floor, because their real positions are unknown."""
    west, south, east, north = corners
    columns = math.ceil(math.sqrt(len(labels)))
    cell = [(east - west) / columns, (north - south) / columns]
    half_m = min(THING_M, *cell) / 2
    items = []
    for place, label in enumerate(labels):
        x_m = west + (place % columns + 0.5) * cell[0]
        y_m = south + (place // columns + 0.5) * cell[1]
        edges = box([x_m - half_m, y_m - half_m, 0.0], [x_m + half_m, y_m + half_m, 2 * half_m])
        centre_m = [round(x_m, 3), round(y_m, 3), round(half_m, 3)]
        items.append({"id": id_of(label, room), "label": label, "position_m": centre_m, "box": edges})
    return items


def scene(home: dict) -> dict:
    """The map of a home: its rooms with the things that have sensors, and with the things in `more`."""
    rooms = home["room"]
    items = []
    for room, corners in rooms.items():
        # A sensor with the name of its room, such as motion, is not a thing. A toilet is one, whatever its room's name.
        own = ((kind, thing) for place, kind, thing in home["sensor"].values() if place == room)
        sensed = [thing for kind, thing in own if kind != "passed" or thing != room]
        labels = list(dict.fromkeys(sensed + home.get("more", {}).get(room, [])))
        items += things(room, corners, labels) if labels else []
    boxes = {room: box([*corners[:2], 0.0], [*corners[2:], HEIGHT_M]) for room, corners in rooms.items()}
    return {
        "format": "roomcast-scene",
        "version": 1,
        "name": home["about"],
        "description": "Rooms, and the things in them that have sensors; nothing is measured.",
        "source": "benches/homes/homes.toml of Roomcast",
        "rooms": [{"id": id_of(room), "label": room, "box": boxes[room]} for room in rooms],
        "doors": [door(rooms, one, other) for one, other in home["doors"]],
        "items": items,
    }


def rules(kinds: dict) -> str:
    """The rules file: the sentences for each kind of interval, and the shortest time between repetitions."""
    keys = ({"kind": kind, "say": said["say"], "again_s": said["again_s"]} for kind, said in kinds.items())
    rule = ("[[rule]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in own.items()) for own in keys)
    return "\n".join(rule)


def table(rows: list[tuple], heading: str) -> str:
    """Lines with tabs; the first two columns are times."""
    lines = ("\t".join([time_of(start_s), time_of(end_s), *rest]) + "\n" for start_s, end_s, *rest in rows)
    return heading + "\n" + "".join(lines)


def translate(data: Path, out: Path, given: dict) -> list[str]:
    """Writes the files of all homes; returns notes on omitted data."""
    out.mkdir(parents=True, exist_ok=True)
    told = []
    (out / "rules.toml").write_text(rules(given["kind"]), encoding="utf-8")
    for letter, home in given["home"].items():
        file = data / home["files"]
        sensor_names = names(file.with_suffix(".sensor_names"))
        log, unnamed = intervals(home, given["kind"], events(file.with_suffix(".sensors")), sensor_names)
        (out / f"{letter}.tsv").write_text(table(log, "Start time\tEnd time\tSensor\tKind\tPlace"), encoding="utf-8")
        (out / f"{letter}-scene.json").write_text(json.dumps(scene(home), indent=1) + "\n", encoding="utf-8")
        if "away" in home:
            activities = events(file.with_suffix(".activities")), names(file.with_suffix(".activity_names"))
            away = table(absences(home, *activities), "Start time\tEnd time\tActivity")
            (out / f"{letter}-away.tsv").write_text(away, encoding="utf-8")
        told.append(f"{letter}: {len(log)} intervals; left out, since their sensors have no names: {unnamed}")
    return told


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="the folder with the source's files")
    parser.add_argument("--out", type=Path, required=True, help="where the translation goes")
    arguments = parser.parse_args()
    try:
        print("\n".join(translate(arguments.data, arguments.out, homes())), file=sys.stderr)
    except (HomeError, OSError) as error:
        print(f"translate: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

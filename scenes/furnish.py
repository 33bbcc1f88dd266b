#!/usr/bin/env python3
"""Furnish the project's own scenes from the plans in `plans/`.

    python3 scenes/furnish.py            rewrite scenes/*.json
    python3 scenes/furnish.py --check    verify the plans, and that scenes/*.json are up to date

A plan says what a person would say: which piece stands at which wall, what lies on it and in it. This script
turns that into boxes in metres and refuses what cannot be: pieces that intersect, things that stick through a
wall, doors that cannot be opened. The same plans always give the same bytes. Python 3.11 or newer, standard
library only. README.md describes both formats.
"""

import json
import re
import sys
import tomllib
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

HERE = Path(__file__).resolve().parent
PLANS = HERE / "plans"

TOUCH_M = 0.0005  # boxes that overlap by less than this along an axis only touch
GAP_M = 0.01  # between neighbours on a shelf, and to its edge
EDGE_M = 0.02  # thickness of a shelf and of the sides of a piece of furniture
DOOR_M = (0.9, 0.04, 2.05)  # along the wall, through it, height
DOOR_CLEAR_M = 0.6  # free floor that a door needs on each side
WALLS = ("north", "south", "east", "west")
PIECE_KEYS = ("put", "wall", "at_m", "centre_m", "size_m", "z_m", "on", "in", "under", "around")


class PlanError(Exception):
    """A plan that cannot be built; the text names the plan, the element and the remedy."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in metres."""

    low: tuple
    high: tuple

    def size(self, axis):
        return self.high[axis] - self.low[axis]

    def centre(self):
        return tuple((low + high) / 2 for low, high in zip(self.low, self.high))

    def overlap(self, other):
        """Edge lengths of the intersection; negative where the boxes are apart."""
        return [min(self.high[a], other.high[a]) - max(self.low[a], other.low[a]) for a in range(3)]

    def volume_shared(self, other):
        x, y, z = (max(0.0, edge) for edge in self.overlap(other))
        return x * y * z

    def meets(self, other):
        if isinstance(other, Prism):
            return other.meets(self)
        return all(edge > TOUCH_M for edge in self.overlap(other))

    def holds(self, other):
        return all(
            self.low[a] <= other.low[a] + 1e-9 and other.high[a] <= self.high[a] + 1e-9 for a in range(3)
        )

    def as_json(self):
        return {"min_m": metres(self.low), "max_m": metres(self.high)}


@dataclass(frozen=True)
class Prism(Box):
    """A room whose floor is no rectangle: an outline with right angles, and the box around it."""

    corners: tuple = ()

    @classmethod
    def over(cls, corners, height_m):
        low, high = (tuple(choose(corner[a] for corner in corners) for a in (0, 1)) for choose in (min, max))
        return cls((*low, 0.0), (*high, height_m), tuple(tuple(corner) for corner in corners))

    def edges(self):
        return list(zip(self.corners, self.corners[1:] + self.corners[:1]))

    def pieces(self):
        """The boxes that it consists of: the cells of the grid through its corners that lie inside."""
        xs, ys = (sorted({corner[a] for corner in self.corners}) for a in (0, 1))
        for west, east in zip(xs, xs[1:]):
            for south, north in zip(ys, ys[1:]):
                x, y = (west + east) / 2, (south + north) / 2
                crossed = sum(a[0] < x < b[0] or b[0] < x < a[0] for a, b in self.edges() if a[1] == b[1] and a[1] > y)
                if crossed % 2:
                    yield Box((west, south, self.low[2]), (east, north, self.high[2]))

    def volume_shared(self, other):
        return sum(piece.volume_shared(other) for piece in self.pieces())

    def meets(self, other):
        if isinstance(other, Prism):
            return any(other.meets(piece) for piece in self.pieces())
        return any(piece.meets(other) for piece in self.pieces())

    def holds(self, other):
        """Whether a box lies inside: of its floor nothing is left when what the pieces hold is taken away."""
        area = other.size(0) * other.size(1)
        held = sum(
            max(0.0, x) * max(0.0, y) for piece in self.pieces() for x, y, _ in [piece.overlap(other)]
        )
        return super().holds(other) and held >= area - 1e-9


@dataclass
class Item:
    label: str
    room: str
    box: Box
    bearer: "Item | None" = None  # the piece it lies on or in; None for pieces that the plan places itself
    id: str = ""


def metres(point):
    """Coordinates to the millimetre, so that the files do not depend on rounding of the last bit."""
    return [round(value, 3) + 0.0 for value in point]


class Scene:
    """One plan, built: `plan`, `catalogue` and `aliases` are the TOML files of those names."""

    def __init__(self, name, plan, catalogue, aliases):
        self.name = name
        self.catalogue = catalogue
        self.plan = plan
        self.items = []
        height_m = self.plan["height_m"]
        self.rooms = {room["id"]: self.space(room, height_m) for room in self.plan["room"]}
        self.doors = [self.door(door) for door in self.plan["door"]]
        for room, pieces in self.plan["place"].items():
            if room not in self.rooms:
                self.fail(f"place.{room}: no room has this id")
            for piece in pieces:
                self.place(room, piece)
        self.number()
        self.aliases = self.choose_aliases(aliases)

    def fail(self, text):
        raise PlanError(text)

    def kind(self, label):
        if label not in self.catalogue:
            self.fail(f"'{label}' is not in plans/catalogue.toml: add it with its size")
        return self.catalogue[label]

    def space(self, room, height_m):
        corners = room.get("corners_m")
        if corners is None:
            return Box((*room["min_m"], 0.0), (*room["max_m"], height_m))
        prism = Prism.over(corners, height_m)
        if len(corners) < 4 or any((a[0] == b[0]) == (a[1] == b[1]) for a, b in prism.edges()):
            self.fail(f"{room['id']}: the corners of corners_m go around, each straight north, south, east or west of the last")
        return prism

    # Placing

    def door(self, door):
        """Finds the wall that two rooms share at the given point and hangs the door there."""
        first, second = (self.rooms[room] for room in door["rooms"])
        point = door["at_m"]
        for axis in (0, 1):
            for plane, inwards in self.walls(first, axis, point):
                shared = plane in [wall for wall, _ in self.walls(second, axis, point)]
                if shared and abs(point[axis] - plane) < 1e-9:
                    along, through, height = DOOR_M
                    low, high = [0.0] * 3, [0.0, 0.0, height]
                    low[1 - axis], high[1 - axis] = point[1 - axis] - along / 2, point[1 - axis] + along / 2
                    low[axis], high[axis] = sorted((plane, plane + inwards * through))
                    self.items.append(Item("door", door["rooms"][0], Box(tuple(low), tuple(high))))
                    low[axis], high[axis] = plane - DOOR_CLEAR_M, plane + DOOR_CLEAR_M
                    clear = Box(tuple(low), tuple(high))
                    return {"rooms": door["rooms"], "position_m": [*point, 1.0], "clear": clear}
        self.fail(f"door {door['rooms']}: {point} is not on a wall that both rooms share")

    def walls(self, room, axis, point):
        """Where a room's walls across an axis are at a point, and which way leads into the room."""
        pieces = list(room.pieces()) if isinstance(room, Prism) else [room]
        beside = [piece for piece in pieces if piece.low[1 - axis] <= point[1 - axis] <= piece.high[1 - axis]]
        planes = [(piece.high[axis], -1) for piece in beside] + [(piece.low[axis], 1) for piece in beside]
        # Where two pieces of a room meet is no wall.
        return [(plane, way) for plane, way in planes if (plane, -way) not in planes]

    def place(self, room, piece):
        """Puts one piece of furniture or one fixture, then what lies on, in, under and around it."""
        label = piece["put"]
        unknown = sorted(set(piece) - set(PIECE_KEYS))
        if unknown:
            self.fail(f"{room}: {label} has {unknown}: a piece can have {', '.join(PIECE_KEYS)}")
        if ("wall" in piece) == ("centre_m" in piece):
            self.fail(f"{room}: {label} needs either a `wall` or a `centre_m`")
        if piece.get("wall", WALLS[0]) not in WALLS:
            self.fail(f"{room}: {label} stands at the wall '{piece['wall']}', which is none of {', '.join(WALLS)}")
        kind = self.kind(label)
        along, depth, height = piece.get("size_m", kind["size_m"])
        box = self.rooms[room]
        z = piece.get("z_m", kind.get("z_m", 0.0))
        if "wall" in piece:
            wall = piece["wall"]
            axis = 0 if wall in ("north", "south") else 1  # along the wall
            low, high = [0.0, 0.0, z], [0.0, 0.0, z + height]
            low[axis] = box.low[axis] + piece["at_m"]
            high[axis] = low[axis] + along
            if wall in ("north", "east"):
                high[1 - axis] = box.high[1 - axis]
                low[1 - axis] = high[1 - axis] - depth
            else:
                low[1 - axis] = box.low[1 - axis]
                high[1 - axis] = low[1 - axis] + depth
        else:
            x, y = (box.low[a] + piece["centre_m"][a] for a in (0, 1))
            if kind.get("ceiling"):
                z = box.high[2] - height
            low = [x - along / 2, y - depth / 2, z]
            high = [x + along / 2, y + depth / 2, z + height]
        item = Item(label, room, Box(tuple(low), tuple(high)))
        self.items.append(item)

        base, top = item.box.low[2], item.box.high[2]
        surface = base + kind["surface_m"] if "surface_m" in kind else top
        # What stands on a piece may be as high as the room; what is inside has its shelf's height.
        self.bear(item, piece.get("on", []), [(surface, box.high[2])])
        self.bear(item, piece.get("under", []), [(base, surface - EDGE_M)])
        shelves = kind.get("shelves", 1)
        step = (top - base) / shelves
        levels = [(base + i * step + EDGE_M, base + (i + 1) * step - EDGE_M) for i in range(shelves)]
        self.bear(item, piece.get("in", []), levels)
        self.surround(item, piece.get("around", []))

    def things(self, entries):
        """Reads entries such as "plate x8" into (label, count)."""
        for entry in entries:
            label, count = re.fullmatch(r"(.+?)(?: x(\d+))?", entry).groups()
            yield label, int(count or 1)

    def bear(self, bearer, entries, levels):
        """Lays things out on one or more levels of a piece: stackable ones as one pile, the others side by side."""
        piles = []
        for label, count in self.things(entries):
            kind = self.kind(label)
            if kind.get("stack"):
                piles.append((label, count))
            else:
                piles.extend([(label, 1)] * count)
        # The levels share the things by width, in the order in which the plan names them.
        total = sum(self.kind(label)["size_m"][0] for label, _ in piles)
        shares = [[] for _ in levels]
        used = 0.0
        for pile in piles:
            width = self.kind(pile[0])["size_m"][0]
            level = min(int((used + width / 2) / total * len(levels)), len(levels) - 1)
            shares[level].append(pile)
            used += width
        for share, level in zip(shares, levels):
            if share:
                self.fill(bearer, share, *level)

    def fill(self, bearer, piles, floor, ceiling):
        """Sets piles in rows along the longer side of the bearer, spread over its length, from the back."""
        axis = 0 if bearer.box.size(0) >= bearer.box.size(1) else 1
        length = bearer.box.size(axis) - 2 * EDGE_M
        rows, row, used = [], [], 0.0
        for pile in piles:
            width = self.kind(pile[0])["size_m"][0]
            if row and used + width + GAP_M > length:
                rows.append(row)
                row, used = [], 0.0
            row.append(pile)
            used += width + GAP_M
        rows.append(row)
        depths = [max(self.kind(label)["size_m"][1] for label, _ in row) for row in rows]
        spare = bearer.box.size(1 - axis) - 2 * EDGE_M - sum(depths)
        if spare < -1e-9:
            names = ", ".join(label for label, _ in piles)
            self.fail(f"{bearer.room}: {bearer.label} is too small for {names}: enlarge it or move some away")
        across = bearer.box.low[1 - axis] + EDGE_M
        for row, depth in zip(rows, depths):
            across += spare / (len(rows) + 1)
            widths = [self.kind(label)["size_m"][0] for label, _ in row]
            gap = (length - sum(widths)) / (len(row) + 1)
            along = bearer.box.low[axis] + EDGE_M
            for (label, count), width in zip(row, widths):
                along += gap
                self.pile(bearer, label, count, axis, along, across, floor, ceiling)
                along += width
            across += depth

    def pile(self, bearer, label, count, axis, along, across, floor, ceiling):
        kind = self.kind(label)
        width, depth, height = kind["size_m"]
        # Clothes on a rail hang from the top of their level; everything else stands on it.
        z = ceiling - height if kind.get("hangs") else floor
        if z < floor or z + count * height > ceiling + 1e-9:
            self.fail(f"{bearer.room}: {count} x {label} is higher than its place in or on {bearer.label}")
        for i in range(count):
            low, high = [0.0, 0.0, z + i * height], [0.0, 0.0, z + (i + 1) * height]
            low[axis], high[axis] = along, along + width
            low[1 - axis], high[1 - axis] = across, across + depth
            self.items.append(Item(label, bearer.room, Box(tuple(low), tuple(high)), bearer))

    def surround(self, table, entries):
        """Sets chairs at the two longer sides of a table, the first half on the lower side."""
        for label, count in self.things(entries):
            width, depth, height = self.kind(label)["size_m"]
            axis = 0 if table.box.size(0) >= table.box.size(1) else 1
            sides = ((count + 1) // 2, count // 2)
            edges = (table.box.low[1 - axis] - depth, table.box.high[1 - axis])
            for seats, edge in zip(sides, edges):
                for seat in range(seats):
                    middle = table.box.low[axis] + table.box.size(axis) * (2 * seat + 1) / (2 * seats)
                    low, high = [0.0, 0.0, 0.0], [0.0, 0.0, height]
                    low[axis], high[axis] = middle - width / 2, middle + width / 2
                    low[1 - axis], high[1 - axis] = edge, edge + depth
                    self.items.append(Item(label, table.room, Box(tuple(low), tuple(high))))

    def number(self):
        """Identifiers: the label and a count over the whole scene, room by room in the order of the plan."""
        order = list(self.rooms)
        self.items.sort(key=lambda item: order.index(item.room))
        seen = {}
        for item in self.items:
            seen[item.label] = seen.get(item.label, 0) + 1
            item.id = f"{item.label.replace(' ', '-')}-{seen[item.label]}"

    def choose_aliases(self, aliases):
        """The shared aliases that this scene can use, and its own: a word means one label, and labels win."""
        labels = {item.label for item in self.items} | {room["label"] for room in self.plan["room"]}
        taken = set(labels)
        chosen = {}
        for table in (self.plan.get("aliases", {}), aliases):
            for label, words in table.items():
                if label not in labels:
                    continue
                free = [word for word in words if word not in taken]
                taken.update(free)
                if free:
                    chosen.setdefault(label, []).extend(free)
        return dict(sorted(chosen.items()))

    # Checking

    def problems(self):
        """Everything wrong with the scene, as sentences."""
        yield from self.count_problems()
        for item in self.items:
            where = f"{item.id} in {item.room}"
            if not self.rooms[item.room].holds(item.box):
                yield f"{where} sticks out of its room: {item.box.as_json()}"
            shares = {room: space.volume_shared(item.box) for room, space in self.rooms.items()}
            if any(share >= shares[item.room] for room, share in shares.items() if room != item.room):
                yield f"{where} overlaps most with another room: {shares}"
        for a, b in combinations(self.items, 2):
            flat = self.kind(a.label).get("flat") or self.kind(b.label).get("flat")
            borne = a.bearer is b or b.bearer is a
            if not flat and not borne and a.box.meets(b.box):
                yield f"{a.id} and {b.id} in {a.room} intersect: {a.box.as_json()} and {b.box.as_json()}"
        for a, b in combinations(self.rooms, 2):
            if self.rooms[a].meets(self.rooms[b]):
                yield f"rooms {a} and {b} intersect"
        for door in self.doors:
            for item in self.items:
                free = item.label == "door" or self.kind(item.label).get("flat")
                if not free and item.box.meets(door["clear"]):
                    yield f"{item.id} stands in the way of the door {door['rooms']}"
        for room in self.plan["room"]:
            for part in room.get("part", []):
                if not self.rooms[room["id"]].holds(self.part_box(part)):
                    yield f"part {part['id']} sticks out of {room['id']}"
            if "part" in room:
                yield from self.part_problems(room)

    def part_problems(self, room):
        """Items that no part of their room holds more of than any other: where they belong would be chance."""
        for item in self.items:
            if item.room != room["id"]:
                continue
            shares = sorted(item.box.volume_shared(self.part_box(part)) for part in room["part"])
            if shares[-1] <= 0.0 or (len(shares) > 1 and shares[-1] - shares[-2] < 0.01 * shares[-1]):
                yield f"{item.id} is in no part of {item.room} more than in another: move it or the parts"

    def count_problems(self):
        found = {
            "rooms": len(self.rooms),
            "items": len(self.items),
            "labels": len({item.label for item in self.items}),
        }
        if found != self.plan["expect"]:
            yield f"the plan expects {self.plan['expect']}, and it makes {found}"
        if len({item.id for item in self.items}) != len(self.items):
            yield "two items have the same id"

    # Writing

    def part_box(self, part):
        return Box((*part["min_m"], 0.0), (*part["max_m"], self.plan["height_m"]))

    def space_json(self, space):
        if isinstance(space, Prism):
            footprint = [[metres(corner) for corner in space.corners]]
            return {"footprint": footprint, "floor": 0.0, "height": space.size(2), "box": space.as_json()}
        return {"box": space.as_json()}

    def text(self):
        """The scene as JSON, one element per line, so that a change of the plan shows as a small difference."""
        rooms = [
            {"id": room["id"], "label": room["label"], **self.space_json(self.rooms[room["id"]])}
            for room in self.plan["room"]
        ]
        parts = [
            {
                "id": f"{room['id']}/{part['id']}",
                "label": part["label"],
                "room": room["id"],
                "box": self.part_box(part).as_json(),
            }
            for room in self.plan["room"]
            for part in room.get("part", [])
        ]
        doors = [
            {"id": "--".join(door["rooms"]), "rooms": door["rooms"], "position_m": metres(door["position_m"])}
            for door in self.doors
        ]
        items = [
            {
                "id": item.id,
                "label": item.label,
                "position_m": metres(item.box.centre()),
                "box": item.box.as_json(),
            }
            for item in self.items
        ]
        fields = {
            "format": "roomcast-scene",
            # A map of boxes stays what it was.
            "version": 2 if any(isinstance(space, Prism) for space in self.rooms.values()) else 1,
            "name": self.name,
            "description": self.plan["description"],
            "source": f"made by scenes/furnish.py from scenes/plans/{self.name}.toml",
            "rooms": rooms,
            "parts": parts,
            "groups": self.plan.get("group", []),
            "doors": doors,
            "aliases": self.aliases,
            "items": items,
        }
        return "{\n" + ",\n".join(f"  {json.dumps(key)}: {rows(value)}" for key, value in fields.items()) + "\n}\n"


def rows(value):
    """A field's JSON: lists and tables with one entry per line."""
    if isinstance(value, list) and value:
        return "[\n" + ",\n".join(f"    {json.dumps(entry)}" for entry in value) + "\n  ]"
    if isinstance(value, dict) and value:
        lines = (f"    {json.dumps(key)}: {json.dumps(entry)}" for key, entry in value.items())
        return "{\n" + ",\n".join(lines) + "\n  }"
    return json.dumps(value)


def report(scene, write):
    """Prints what is wrong with a scene, and writes it if nothing is and it should; returns how much is wrong."""
    problems = list(scene.problems())
    out = HERE / f"{scene.name}.json"
    if write and not problems:
        out.write_text(scene.text(), encoding="utf-8")
    if not write and (not out.exists() or out.read_text(encoding="utf-8") != scene.text()):
        problems.append(f"{out.name} is not what the plan makes: run scenes/furnish.py")
    for problem in problems:
        print(f"{scene.name}: {problem}", file=sys.stderr)
    labels = {item.label for item in scene.items}
    print(f"{scene.name}: {len(scene.items)} items, {len(labels)} labels, {len(problems)} problems")
    return len(problems)


def main(arguments):
    if arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    catalogue = tomllib.loads((PLANS / "catalogue.toml").read_text(encoding="utf-8"))
    aliases = tomllib.loads((PLANS / "aliases.toml").read_text(encoding="utf-8"))
    wrong = 0
    for path in sorted(PLANS.glob("*.toml")):
        if path.stem in ("catalogue", "aliases"):
            continue
        try:
            plan = tomllib.loads(path.read_text(encoding="utf-8"))
            scene = Scene(path.stem, plan, catalogue, aliases)
        except (PlanError, tomllib.TOMLDecodeError, KeyError) as error:
            text = f"{error} is missing, or nothing has this name" if isinstance(error, KeyError) else error
            print(f"{path.name}: {text}", file=sys.stderr)
            wrong += 1
            continue
        wrong += report(scene, write=not arguments)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

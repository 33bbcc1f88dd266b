"""Every rule of furnish.py refuses the plan that breaks it, and the scenes and programs are what README.md says.

    python3 -m unittest discover -s scenes
"""

import copy
import json
import re
import unittest
from pathlib import Path

import furnish

HERE = Path(__file__).resolve().parent

CATALOGUE = {
    "desk": {"size_m": [1.4, 0.7, 0.75]},
    "shelf": {"size_m": [0.9, 0.3, 1.8], "shelves": 3},
    "plate": {"size_m": [0.24, 0.24, 0.02], "stack": True},
    "mug": {"size_m": [0.1, 0.1, 0.1]},
    "rug": {"size_m": [2.0, 2.0, 0.01], "flat": True},
    "door": {"size_m": [0.9, 0.04, 2.05]},
}

PLAN = {
    "description": "two rooms",
    "height_m": 2.5,
    "expect": {"rooms": 2, "items": 9, "labels": 6},
    "room": [
        {"id": "a", "label": "kitchen", "min_m": [0.0, 0.0], "max_m": [4.0, 4.0]},
        {"id": "b", "label": "bedroom", "min_m": [4.0, 0.0], "max_m": [8.0, 4.0]},
    ],
    "door": [{"rooms": ["a", "b"], "at_m": [4.0, 2.0]}],
    "place": {
        "b": [{"put": "desk", "wall": "east", "at_m": 1.0, "on": ["mug"]}],
        "a": [
            {"put": "shelf", "wall": "north", "at_m": 0.0, "in": ["plate x3"], "on": ["mug"]},
            {"put": "rug", "centre_m": [2.0, 2.0]},
        ],
    },
}


def build(change=lambda plan: None, aliases=()):
    plan = copy.deepcopy(PLAN)
    change(plan)
    return furnish.Scene("test", plan, CATALOGUE, dict(aliases))


class Building(unittest.TestCase):
    def test_a_good_plan_has_no_problems_and_always_the_same_text(self):
        self.assertEqual(list(build().problems()), [])
        self.assertEqual(build().text(), build().text())

    def test_a_piece_stands_flush_with_its_wall(self):
        desk = next(item for item in build().items if item.label == "desk")
        self.assertEqual(furnish.metres(desk.box.low), [7.3, 1.0, 0.0])
        self.assertEqual(furnish.metres(desk.box.high), [8.0, 2.4, 0.75])

    def test_stacked_things_lie_on_one_another_inside_their_bearer(self):
        scene = build()
        plates = [item for item in scene.items if item.label == "plate"]
        for below, above in zip(plates, plates[1:]):
            self.assertAlmostEqual(below.box.high[2], above.box.low[2])
        self.assertTrue(all(item.bearer.box.holds(item.box) for item in plates))

    def test_ids_are_counted_room_by_room_in_the_order_of_the_rooms(self):
        first = next(item for item in build().items if item.id == "mug-1")
        self.assertEqual(first.room, "a")

    def test_an_alias_never_shadows_a_label_and_never_means_two(self):
        scene = build(aliases={"mug": ["cup", "desk"], "plate": ["cup", "dish"], "sofa": ["couch"]})
        self.assertEqual(scene.aliases, {"mug": ["cup"], "plate": ["dish"]})


class Angles(unittest.TestCase):
    """Rooms with right angles that are no boxes: an L around the corner that room b takes up."""

    L = [[0.0, 0.0], [8.0, 0.0], [8.0, 2.0], [4.0, 2.0], [4.0, 4.0], [0.0, 4.0]]

    @staticmethod
    def plan(plan):
        plan["room"][0] = {"id": "a", "label": "kitchen", "corners_m": Angles.L}
        plan["room"][1].update(min_m=[4.0, 2.0])
        plan["place"]["b"][0]["at_m"] = 0.3
        plan["door"][0]["at_m"] = [4.0, 3.0]

    def test_an_outline_is_written_and_the_box_around_it_counts_for_nothing(self):
        scene = build(Angles.plan)
        self.assertEqual(list(scene.problems()), [])
        text = json.loads(scene.text())
        self.assertEqual(text["version"], 2)
        self.assertEqual(text["rooms"][0]["footprint"], [Angles.L])
        self.assertEqual(text["rooms"][0]["box"], {"min_m": [0.0, 0.0, 0.0], "max_m": [8.0, 4.0, 2.5]})
        self.assertEqual(json.loads(build().text())["version"], 1)

    def test_a_piece_in_the_corner_that_is_left_out_sticks_out(self):
        def change(plan):
            Angles.plan(plan)
            plan["place"]["a"].append({"put": "mug", "centre_m": [6.0, 3.0]})

        found = list(build(change).problems())
        self.assertTrue(any("sticks out of its room" in problem for problem in found), found)
        self.assertTrue(any("overlaps most with another room" in problem for problem in found), found)

    def test_an_inner_wall_has_doors_and_the_middle_of_a_room_has_none(self):
        def inner(plan):
            Angles.plan(plan)
            plan["door"][0]["at_m"] = [6.0, 2.0]

        self.assertEqual(build(inner).doors[0]["position_m"], [6.0, 2.0, 1.0])

        def middle(plan):
            Angles.plan(plan)
            plan["door"][0]["at_m"] = [4.0, 1.0]

        with self.assertRaisesRegex(furnish.PlanError, "not on a wall"):
            build(middle)

    def test_corners_that_go_askew_are_refused(self):
        def change(plan):
            Angles.plan(plan)
            plan["room"][0]["corners_m"] = [[0.0, 0.0], [8.0, 0.0], [4.0, 4.0], [0.0, 4.0]]

        with self.assertRaisesRegex(furnish.PlanError, "each straight north, south, east or west"):
            build(change)


class Refusing(unittest.TestCase):
    def found(self, change, words):
        self.assertTrue(any(words in problem for problem in build(change).problems()), list(build(change).problems()))

    def refused(self, change, words):
        with self.assertRaisesRegex(furnish.PlanError, words):
            build(change)

    def test_wrong_numbers(self):
        self.found(lambda plan: plan["expect"].update(items=8), "the plan expects")

    def test_pieces_that_intersect(self):
        self.found(lambda plan: plan["place"]["b"].append({"put": "shelf", "wall": "east", "at_m": 1.5}), "intersect")

    def test_a_piece_through_a_wall(self):
        self.found(lambda plan: plan["place"]["b"][0].update(at_m=3.0), "sticks out of its room")

    def test_a_piece_in_the_way_of_a_door(self):
        self.found(lambda plan: plan["place"]["b"].append({"put": "shelf", "wall": "west", "at_m": 1.6}), "in the way")

    def test_rooms_that_intersect(self):
        self.found(lambda plan: plan["room"].append({**plan["room"][0], "id": "c"}), "rooms a and c intersect")

    def test_a_part_beyond_its_room(self):
        part = {"id": "p", "label": "corner", "min_m": [3.0, 0.0], "max_m": [5.0, 4.0]}
        self.found(lambda plan: plan["room"][0].update(part=[part]), "part p sticks out")

    def test_an_item_that_two_parts_share(self):
        halves = [
            {"id": "p", "label": "west side", "min_m": [0.0, 0.0], "max_m": [2.0, 4.0]},
            {"id": "q", "label": "east side", "min_m": [2.0, 0.0], "max_m": [4.0, 4.0]},
        ]
        self.found(lambda plan: plan["room"][0].update(part=halves), "rug-1 is in no part")

    def test_a_door_that_is_in_no_shared_wall(self):
        self.refused(lambda plan: plan["door"][0].update(at_m=[3.0, 2.0]), "not on a wall")

    def test_more_than_fits(self):
        self.refused(lambda plan: plan["place"]["a"][0].update({"in": ["mug x60"]}), "too small")
        self.refused(lambda plan: plan["place"]["a"][0].update({"in": ["plate x60"]}), "higher than its place")

    def test_words_that_mean_nothing(self):
        self.refused(lambda plan: plan["place"]["a"][0].update(put="sofa"), "not in plans/catalogue.toml")
        self.refused(lambda plan: plan["place"]["a"][0].update(wall="left"), "none of north")
        self.refused(lambda plan: plan["place"]["a"][0].update(colour="red"), "colour")
        self.refused(lambda plan: plan["place"]["a"][1].update(wall="north"), "either")
        self.refused(lambda plan: plan["place"].update(c=[]), "no room has this id")


class Shipped(unittest.TestCase):
    """What README.md says about the files here."""

    ACTIONS = {"g0": 16, "g1": 19, "g2": 17, "p0": 18, "p1": 16, "p2": 42, "w0": 20, "w1": 19, "w2": 19}
    SCENES = {"p": "apartment-e0 apartment-e1 apartment-e2 studio", "w": "ward", "g": "warehouse"}

    def test_programs_have_their_length_and_their_scenes_have_their_objects(self):
        programs = sorted((HERE / "programs").glob("*.txt"))
        self.assertEqual([path.name[:2] for path in programs], list(self.ACTIONS))
        for program in programs:
            title, description, *empty = program.read_text(encoding="utf-8").split("\n")[:4]
            steps = program.read_text(encoding="utf-8").split("\n")[4:-1]
            self.assertTrue(title and description and empty == ["", ""])
            self.assertEqual(len(steps), self.ACTIONS[program.name[:2]])
            for step in steps:
                self.assertRegex(step, r"^\[[A-Za-z]+\]( <[a-z_]+> \(\d+\)){0,2}$")
            objects = {name.replace("_", " ") for step in steps for name in re.findall("<(.*?)>", step)}
            for name in self.SCENES[program.name[0]].split():
                scene = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
                labels = {entry["label"] for entry in scene["items"] + scene["rooms"]}
                self.assertEqual(objects - labels, set(), f"{program.name} in {name}")

    def test_the_table_of_scenes_has_their_numbers(self):
        readme = (HERE / "README.md").read_text(encoding="utf-8")
        rows = re.findall(r"^\| `([a-z0-9-]+)\.json` \| (\d+) \| (\d+) \| (\d+) \|", readme, re.MULTILINE)
        self.assertEqual(len(rows), len(list(HERE.glob("*.json"))))
        for name, *numbers in rows:
            scene = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
            labels = {item["label"] for item in scene["items"]}
            found = [len(scene["rooms"]), len(scene["items"]), len(labels)]
            self.assertEqual([int(number) for number in numbers], found)


if __name__ == "__main__":
    unittest.main()

"""A planner in ten lines: sends the robot where the person is least likely to go next."""

from contextlib import suppress

from roomcast import Planner

with suppress(KeyboardInterrupt), Planner("calm-planner") as planner:
    for scores in planner.scores():
        calmest = min(scores.rooms, key=lambda room: room.probability)
        planner.decide(calmest.id, f"{calmest.probability:.0%} likely to be next")
        print(f"go to {calmest.id} (scores are {scores.age_s * 1e3:.0f} ms old)", flush=True)

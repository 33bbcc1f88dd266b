"""A planner in ten lines: sends the robot to the room that is least likely to be occupied in a minute."""

from contextlib import suppress

from roomcast import Planner

with suppress(KeyboardInterrupt), Planner("robot") as planner:
    for forecast in planner.forecasts():
        calmest = min(forecast.rooms, key=lambda room: forecast.occupied(room.id, 60))
        planner.decide(calmest.id, f"occupied in a minute with {forecast.occupied(calmest.id, 60):.0%}")
        print(f"go to {calmest.id} (the forecast is {forecast.age_s * 1e3:.0f} ms old)", flush=True)

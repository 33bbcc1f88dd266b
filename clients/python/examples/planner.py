"""A planner: sends the robot to the room that is least likely to be occupied in a minute, and stops it while nothing is known of the persons."""

from contextlib import suppress

from roomcast import ForecastFlags, Planner

with suppress(KeyboardInterrupt), Planner("robot") as planner:
    while True:
        for forecast in planner.forecasts(timeout_s=2):
            if ForecastFlags.NOT_KNOWN in forecast.flags:
                planner.pause("no person was observed yet")
                continue
            calmest = min(forecast.rooms, key=lambda room: forecast.occupied(room.id, 60))
            planner.decide(calmest.id, f"occupied in a minute with {forecast.occupied(calmest.id, 60):.0%}")
            print(f"go to {calmest.id} (the forecast is {forecast.age_s * 1e3:.0f} ms old)", flush=True)
        planner.pause("no forecast for two seconds")

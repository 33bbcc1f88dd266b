"""Prints, for each horizon of a forecast, the room that is most likely occupied then."""

from contextlib import suppress

from roomcast import Forecasts

with suppress(KeyboardInterrupt), Forecasts() as forecasts:
    for forecast in forecasts:
        for index, horizon_s in enumerate(forecast.horizons_s):
            room = max(forecast.rooms, key=lambda room: room.probabilities[index])
            print(f"in {horizon_s:.0f} s: {room.id} is occupied with {room.probabilities[index]:.0%}", flush=True)

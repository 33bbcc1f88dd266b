"""Prints, for each person and horizon, the places that they are in with the coverage of the sets, or else the likeliest room."""

from contextlib import suppress

from roomcast import PersonForecasts, Subscription

with suppress(KeyboardInterrupt), Subscription(PersonForecasts, "example-person-forecasts") as subscription:
    for forecasts in subscription:
        for person in forecasts.persons:
            for index, horizon_s in enumerate(forecasts.horizons_s):
                places = [max(person.rooms, key=lambda room: room.probabilities[index]).id]
                if person.sets:
                    places = [*person.sets[index].rooms, *["elsewhere"] * person.sets[index].elsewhere]
                print(f"{person.name or person.person} in {horizon_s:.0f} s: {' or '.join(places)}", flush=True)

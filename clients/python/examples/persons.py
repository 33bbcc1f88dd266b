"""Prints, for each person, whether they are at home, and the room that they most likely go to next."""

from contextlib import suppress

from roomcast import PersonScores, Subscription

with suppress(KeyboardInterrupt), Subscription(PersonScores, "example-persons") as subscription:
    for scores in subscription:
        for person in scores.persons:
            room = max(person.rooms, key=lambda room: room.probability)
            place = room.id if room.probability > person.elsewhere else "elsewhere"
            print(f"{person.name or person.person} is {person.presence.name.lower()}: {place} next", flush=True)

"""Prints, for each person, the room that they most likely go to next."""

from roomcast import PersonScores, Subscription

with Subscription(PersonScores, "example-persons") as subscription:
    for scores in subscription:
        for person in scores.persons:
            room = max(person.rooms, key=lambda room: room.probability)
            print(f"person {person.person}: {room.id} with {room.probability:.0%}", flush=True)

"""Prints the room scores as they come, most likely room first."""

from contextlib import suppress

from roomcast import RoomScores, Subscription

with suppress(KeyboardInterrupt), Subscription(RoomScores, "example-scores") as subscription:
    for scores in subscription:
        rooms = sorted(scores.rooms, key=lambda room: -room.probability)
        print(f"scores {scores.sequence}:", ", ".join(f"{room.id} {room.probability:.0%}" for room in rooms), flush=True)

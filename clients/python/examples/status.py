"""Prints the daemon's counters every second."""

from roomcast import StatusSubscription

with StatusSubscription("example-status", every_s=1) as subscription:
    for status in subscription:
        print(f"{status.map}: {status.accepted} narrations, {status.malformed} malformed, {status.steps} steps", flush=True)

"""Prints the daemon's counters every second."""

from contextlib import suppress

from roomcast import StatusSubscription

with suppress(KeyboardInterrupt), StatusSubscription("example-status", every_s=1) as subscription:
    for status in subscription:
        print(f"{status.map}: {status.accepted} narrations, {status.malformed} malformed, {status.steps} steps", flush=True)

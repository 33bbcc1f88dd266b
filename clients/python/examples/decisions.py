"""Prints every robot's decisions, and says so when none came for a minute."""

from contextlib import suppress

from roomcast import Action, Decision, Subscription

DOES = {Action.GO: "goes to", Action.STAY: "waits in", Action.PAUSE: "pauses in"}

with suppress(KeyboardInterrupt), Subscription(Decision, "example-decisions") as subscription:
    while True:
        decision = subscription.next(timeout_s=60)
        if decision is None:
            print("no decision for a minute", flush=True)
            continue
        does = f"{DOES[decision.action]} {decision.to_room or 'whichever room it is in'}"
        instead = f", instead of decision {decision.cancels}" if decision.cancels else ""
        print(f"robot {decision.robot:016x} {does}{instead}: {decision.reason}", flush=True)

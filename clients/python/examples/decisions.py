"""Prints every robot's decisions, and says so when none came for a minute."""

from roomcast import Decision, Subscription

with Subscription(Decision, "example-decisions") as subscription:
    while True:
        decision = subscription.next(timeout_s=60)
        if decision is None:
            print("no decision for a minute", flush=True)
        else:
            print(f"robot {decision.robot:016x} goes to {decision.to_room or 'no room'}: {decision.reason}", flush=True)

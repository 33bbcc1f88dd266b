"""Prints the item that scores most in each snapshot; the daemon sends item scores as long as somebody follows them."""

from contextlib import suppress

from roomcast import ItemScoresSubscription

with suppress(KeyboardInterrupt), ItemScoresSubscription("example-items") as subscription:
    for scores in subscription:
        likely = max(scores.items, key=lambda item: item.log_score_nats, default=None)
        if likely is not None:
            print(f"scores {scores.sequence}: {likely.id} ({likely.label}) at {likely.log_score_nats:.2f} nats", flush=True)

"""Sends the lines of standard input as sentences, and prints what the daemon makes of them."""

import sys
from contextlib import suppress

from roomcast import MessageError, Narrator

with suppress(KeyboardInterrupt), Narrator("example-narrator") as narrator:
    for line in sys.stdin:
        try:
            narrator.say(line.strip())
        except MessageError as error:
            print(f"not said: {error}", flush=True)
            continue
        scores = narrator.wait_until_included()
        print({room.id: round(room.probability, 3) for room in scores.rooms} if scores else "no answer", flush=True)

"""A narrator in ten lines: sends the lines of standard input as sentences, and prints what the daemon makes of them."""

import sys
from contextlib import suppress

from roomcast import Narrator

with suppress(KeyboardInterrupt), Narrator("example-narrator") as narrator:
    for line in sys.stdin:
        narrator.say(line.strip())
        scores = narrator.wait_until_included()
        print({room.id: round(room.probability, 3) for room in scores.rooms} if scores else "no answer", flush=True)

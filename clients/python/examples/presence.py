"""Says who is where, as a sensor knows it; no sentence is needed for it."""

from roomcast import Narrator

with Narrator("example-presence") as narrator:
    narrator.presence("present", room="kitchen", person="ada")
    narrator.presence("away", person="ben")
    scores = narrator.wait_until_included()
    print("the daemon knows" if scores else "no answer", flush=True)

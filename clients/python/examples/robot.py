"""A robot in ten lines: follows its decisions and reports what becomes of them. Its work is a pause."""

import time
from contextlib import suppress

from roomcast import Action, Robot

with suppress(KeyboardInterrupt), Robot("robot") as robot:
    for decision in robot.decisions():
        if decision.action == Action.PAUSE:
            robot.docked(battery=0.9)
        if decision.action != Action.GO:        # it has nothing to do
            continue
        robot.started()
        time.sleep(0.1)
        robot.finished(note="with a wet mop")
        print(f"{decision.to_room} is done", flush=True)

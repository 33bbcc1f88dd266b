"""A robot: follows its decisions and reports what becomes of them. Its work is a pause."""

import time
from contextlib import suppress

from roomcast import Action, DecisionFlags, Robot

done = None
with suppress(KeyboardInterrupt), Robot("robot") as robot:
    for decision in robot.decisions():
        if decision.action == Action.PAUSE:
            robot.docked(battery=0.9)
        if decision.action != Action.GO:            # it has nothing to do
            continue
        if DecisionFlags.OWED in decision.flags:    # it was asked for before: say what became of it
            if decision.to_room == done:
                robot.finished()
            else:
                robot.failed(note="what became of it is not known")
            continue
        robot.started()
        time.sleep(0.1)
        robot.finished(note="with a wet mop")
        done = decision.to_room
        print(f"{done} is done", flush=True)

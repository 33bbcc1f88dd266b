"""A robot: follows its decisions and reports the results. Its work is five short steps, so that a decision can end it between two of them."""

import time
from contextlib import suppress

from roomcast import Action, DecisionFlags, Robot

STEPS = 5
room, left, done = "", 0, ""                # the room of its work, the steps that are left there, the room that it did last
with suppress(KeyboardInterrupt), Robot("robot") as robot:
    while True:
        decision = robot.next(timeout_s=0 if left else None)    # at work it only looks
        if decision is None or (left and decision.to_room == room and decision.action != Action.PAUSE):
            pass                            # it goes on
        elif decision.action != Action.GO:  # the work ends
            left = 0
            if decision.action == Action.PAUSE:
                robot.docked(battery=0.9)
        elif DecisionFlags.OWED in decision.flags:  # the planner asks for the outcome of earlier work
            left = 0
            if decision.to_room == done:
                robot.finished()
            else:
                robot.failed(note="the outcome is not known")
        else:
            robot.started()
            room, left = decision.to_room, STEPS
        if left:
            time.sleep(0.02)
            left -= 1
            if not left:
                robot.finished(note="with a wet mop")
                done = room
                print(f"{done} is done", flush=True)

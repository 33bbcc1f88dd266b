"""Prints what robots report."""

from contextlib import suppress

from roomcast import RobotReport, Subscription

with suppress(KeyboardInterrupt), Subscription(RobotReport, "example-reports") as subscription:
    for report in subscription:
        print(f"{report.robot_name}: {report.kind.name.lower()} {report.room} {report.note}", flush=True)

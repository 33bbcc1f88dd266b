#!/usr/bin/env python3
"""Starts Roomcast as an add-on of Home Assistant: the options become files of `roomcast init`, the broker comes from the supervisor.

`init` runs at the first start and after a change of the options. The files before stay as NAME.old.
"""

import json
import os
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

DATA = Path(os.environ.get("ROOMCAST_ADD_ON_DATA", "/data"))
CONFIG = Path(os.environ.get("ROOMCAST_ADD_ON_CONFIG", "/config"))


def broker():
    """The supervisor's MQTT service: address and login."""
    request = urllib.request.Request(
        os.environ.get("ROOMCAST_ADD_ON_SUPERVISOR", "http://supervisor") + "/services/mqtt",
        headers={"Authorization": f"Bearer {os.environ['SUPERVISOR_TOKEN']}"},
    )
    with urllib.request.urlopen(request, timeout=10) as answer:
        return json.load(answer)["data"]


def arguments(options, mqtt, credentials):
    """What `roomcast init` gets from the options."""
    scheme = "mqtts" if mqtt.get("ssl") else "mqtt"
    words = ["--yes", "--replace", "--out", CONFIG, "--home-assistant", "/homeassistant", "--mqtt", f"{scheme}://{mqtt['host']}:{mqtt['port']}"]
    if mqtt.get("username"):
        words += ["--mqtt-credentials", credentials]
    words += ["--valetudo", "mqtt" if options.get("robot_map") else "none"]
    if options.get("robot"):
        words += ["--robot", options["robot"]]
    for option, values in [("--resident", "residents"), ("--leave-out", "leave_out"), ("--quiet", "quiet")]:
        for value in options.get(values) or (["none"] if values == "quiet" else []):
            words += [option, value]
    return list(map(str, words))


def write_login(mqtt, credentials):
    credentials.touch(mode=0o600)
    credentials.write_text(f"{mqtt.get('username', '')}\n{mqtt.get('password', '')}\n")


def main():
    options = json.loads((DATA / "options.json").read_text())
    mqtt, credentials, configuration = broker(), DATA / "mqtt-login", CONFIG / "roomcast.toml"
    write_login(mqtt, credentials)
    words, last = arguments(options, mqtt, credentials), DATA / "init.json"
    made = json.dumps([words, options.get("obey")])
    if not configuration.exists() or not last.exists() or last.read_text() != made:
        while subprocess.run(["roomcast", "init", *words], check=False).returncode != 0:
            print("add-on: `roomcast init` failed; it is tried again in a minute", file=sys.stderr, flush=True)
            time.sleep(60)
        if options.get("obey"):
            configuration.write_text(configuration.read_text().replace("\nobey = false\n", "\nobey = true\n"))
        last.write_text(made)
    services = ["daemon", "planner", "narrate --mqtt --name mqtt", "publish mqtt", "view --no-key"]
    if "\n[robot]\n" in configuration.read_text():
        services.append("robot")
    state = DATA / "state"
    state.mkdir(mode=0o700, exist_ok=True)
    Path("/run/roomcast").mkdir(mode=0o700, exist_ok=True)
    os.environ |= {"ROOMCAST_CONFIG": str(configuration), "ROOMCAST_ROOT": "/run/roomcast/domain", "STATE_DIRECTORY": str(state)}
    subprocess.run(["nginx"], check=True)
    os.execv("/usr/lib/roomcast/run", ["run", *services])


if __name__ == "__main__":
    main()

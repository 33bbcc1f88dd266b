"""What `.ci/count` makes of the logs that it reads."""

import subprocess
import unittest
from pathlib import Path

COUNT = Path(__file__).parent / "count"

CARGO = """
running 4 tests
SKIPPED roomcast::mqtt::tests::a_broker: mosquitto is not installed (apt-get install mosquitto)
test mqtt::tests::a_broker ... ok
test \x1b[1mother\x1b[0m ... ok
test slow ... ignored, takes an hour
test plain ... ignored
test later ... ignored, full
test result: \x1b[32mok\x1b[0m. 2 passed; 0 failed; 3 ignored; 0 measured; 0 filtered out; finished in 0.00s
"""


class Counting(unittest.TestCase):
    def count(self, log: str, status: int = 0) -> list[str]:
        done = subprocess.run([COUNT, str(status)], input=log, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    def test_a_rust_test_that_says_it_is_skipped_has_not_passed(self):
        lines = self.count(CARGO)
        self.assertEqual(lines[-1], "1 passed, 0 failed, 3 skipped")
        self.assertIn("  roomcast::mqtt::tests::a_broker: mosquitto is not installed (apt-get install mosquitto)", lines)
        self.assertIn("  slow: takes an hour", lines)
        self.assertIn("  plain: ignored", lines)

    def test_a_test_is_skipped_once_and_found_within_a_line(self):
        line = "SKIPPED scoring::maps: no data\n"
        log = f"test maps ... {line}{line}ok\ntest result: ok. 1 passed; 0 failed; 0 ignored\n"
        self.assertEqual(self.count(log), ["skipped:", "  scoring::maps: no data", "0 passed, 0 failed, 1 skipped"])

    def test_pytest_and_make(self):
        log = "SKIPPED [3] a/test_b.py:14: no PyTorch\n12 passed, 3 skipped, 1 warning in 70.31s (0:01:10)\n"
        log += "1 failed, 2 passed, 1 error in 0.10s\nno tests ran in 0.01s\nSKIPPED licences: cargo-deny is not installed\n"
        lines = self.count(log, 2)
        self.assertEqual(lines[-1], "14 passed, 2 failed, 4 skipped")
        self.assertIn("  a/test_b.py:14: no PyTorch", lines)
        self.assertIn("  licences: cargo-deny is not installed", lines)

    def test_unittest(self):
        log = "test_a (b.C.test_a) ... skipped 'no data'\n\nRan 5 tests in 0.10s\n\nOK (skipped=1)\n"
        log += "Ran 4 tests in 0.10s\n\nFAILED (failures=1, errors=2)\nOK\n"
        self.assertEqual(self.count(log, 2)[-1], "5 passed, 3 failed, 1 skipped")

    def test_what_fails_without_being_a_test_is_a_failure(self):
        self.assertEqual(self.count("error: could not compile\n", 2)[-1], "0 passed, 1 failed, 0 skipped")
        self.assertEqual(self.count(""), ["0 passed, 0 failed, 0 skipped"])


if __name__ == "__main__":
    unittest.main()

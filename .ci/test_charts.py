"""The charts of the manual show the numbers of its tables."""

import subprocess
import unittest
from pathlib import Path


class Charts(unittest.TestCase):
    def test_charts_are_drawn_from_the_tables_of_today(self):
        done = subprocess.run([Path(__file__).parent / "charts", "--check"], capture_output=True, text=True, check=False)
        self.assertEqual((done.returncode, done.stdout + done.stderr), (0, ""))

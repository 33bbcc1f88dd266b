"""Each old fault can still be put back: `make faults` takes too long to say so at each change."""

import subprocess
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


class Faults(unittest.TestCase):
    def test_each_patch_fits_the_code(self):
        patches = sorted((ROOT / "tests/faults").glob("*.patch"))
        self.assertGreaterEqual(len(patches), 15)
        for patch in patches:
            with self.subTest(patch.stem):
                subprocess.run(["git", "apply", "--check", "-C1", patch], cwd=ROOT, check=True, capture_output=True)


if __name__ == "__main__":
    unittest.main()

"""A zenoh router for tests, until standard input ends: router.py CONFIGURATION"""

import sys

import zenoh

session = zenoh.open(zenoh.Config.from_file(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
session.close()

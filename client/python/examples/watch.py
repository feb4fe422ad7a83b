"""Prints the energy of a plant while somebody drives it: python watch.py PLANT [ADDRESS]"""

import sys

import plantd

plant = sys.argv[1]
address = sys.argv[2] if len(sys.argv) > 2 else "http://127.0.0.1:50051"
with plantd.connect(address) as client:
    for message in client.watch(plant, ["state", "energy"], every=10):
        print(f"{message.state.time:8.2f} s  {message.energy.total:+.9f} J  ({message.dropped} lost)")

"""Run a scenario's processes (cameras, emulated network, edge server) from a script, watch them, read the report.

python examples/deployment.py room 60 runs/room
"""

import sys
import time

import freshfield as ff

scenario, seconds, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]
with ff.deployment(scenario, seconds=seconds, out=out) as run:
    print("page:", run.page)
    while run.running:
        print(run.status().get("updates"))
        time.sleep(2.0)
shown = run.report["fidelity"]["shown"]
print(f"shown: {shown['psnr_db']:.2f} dB, all frames accounted for: {run.report['frames']['closes']}")

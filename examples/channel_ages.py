"""The ages of four cameras' newest frames behind an emulated network, as arrays and as a plot.

python examples/channel_ages.py ages.png
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import freshfield as ff

channel = ff.Channel("ch5", service="exp:90ms", cameras=4, seed=1)
t_s, ages_ms = channel.ages(seconds=10)  # (T,), (4, T)
for camera, frames in channel.deliveries(seconds=10).items():
    delays_ms = frames[:, 1] - frames[:, 0]
    print(f"{camera}: {len(frames)} frames arrived, {delays_ms.mean():.0f} ms after capture")
print(f"mean age {np.nanmean(ages_ms):.0f} ms")
plt.plot(t_s, ages_ms.T, lw=0.8)
plt.xlabel("seconds")
plt.ylabel("age of the newest frame, ms")
plt.savefig(sys.argv[1])

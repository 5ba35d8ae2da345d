"""Fit pictures with poses (nerfstudio, COLMAP, ...) and write their Gaussians for a splat viewer.

python examples/own_data.py ~/data/lego lego.ply 60
"""

import sys

import freshfield as ff

path, out, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
data = ff.load(path, holdout=8)
print(data.describe())
fit = ff.fit(data, seconds=seconds, progress=lambda row: print(f"{row.t_s:6.1f} s  {row.psnr_db:.2f} dB"))
fit.export(out)
fit.save(out + "-fit")  # a folder that ff.load, edge-server render and edge-server export open

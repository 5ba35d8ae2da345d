"""A video of a saved run or fit along a path of one's own: here a circle round what its cameras look at.

python examples/novel_views.py runs/fit-lego orbit.mp4 100
"""

import sys

import freshfield as ff

run, out, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
scene = ff.load(run)
poses = scene.orbit(count)  # camera-to-world (4, 4), OpenCV axes, meters: any others do
ff.write_video(out, (scene.render(pose, size=(320, 240)) for pose in poses), fps=25)
print(f"depth of the first image: {scene.depth(poses[0], size=(320, 240)).max():.2f} m at most")

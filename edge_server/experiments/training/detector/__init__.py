"""Trains the small detector whose backbone gives the default embeddings, on synthetic scenes.

scenes.py             variations of the shipped worlds, with exact boxes
object_scenes.py      variations of one object among other things, with masks
dataset.py            renders them and keeps the images
network.py, loss.py   the network and its loss, of the YOLOv8 family
training.py           resumable training
export.py             export to ONNX in float32 and 8 bits
average_precision.py  quality of the boxes
mask_quality.py       quality of the masks
perceptual.py         fits a perceptual distance on the same backbone
"""

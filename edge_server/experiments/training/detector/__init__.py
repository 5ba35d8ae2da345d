"""Trains the small detector whose backbone gives the default embeddings, on our own scenes.

scenes.py             variations of the shipped worlds, with exact boxes
dataset.py            renders them and keeps the images
network.py, loss.py   of the YOLOv8 family
training.py           training, resumable
export.py             ONNX in float32 and 8 bits
average_precision.py  the detector's quality
perceptual.py         fits a perceptual distance on the same backbone
"""

"""Trains the small detector whose backbone gives the default embeddings, on synthetic scenes.

scenes.py             variations of the shipped worlds, with exact boxes
dataset.py            renders them and keeps the images
network.py, loss.py   the network and its loss, of the YOLOv8 family
training.py           resumable training
export.py             export to ONNX, with the projection for embeddings
precision.py          quality of the boxes, by pycocotools
"""

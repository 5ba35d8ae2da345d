"""The small detector whose backbone makes the default embeddings, trained by us on our own scenes.

``scenes`` varies the shipped worlds and knows exact boxes, ``dataset`` renders and keeps them, ``network``
and ``loss`` are of the YOLOv8 family, ``training`` runs, ``export`` writes ONNX in float32 and 8 bits,
``average_precision`` measures quality. ``perceptual`` fits a perceptual distance on the same backbone.
"""

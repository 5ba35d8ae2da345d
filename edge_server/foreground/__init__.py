"""Foreground segmentation of images before the field is trained (thesis 4.4.3).

A YOLO segmentation model detects the object and labels its pixels; the mask within the box stays, and the
background becomes transparent, which supervises the field with empty space there. Poses do not change. The
scenario key ``edge.foreground`` enables it; without that key this package is not imported. Held-out frames
are not masked: fidelity is measured on whole images, background included.
"""

# Why an image is used whole, by the name of its count (``foreground.Foreground``).
WHY = {
    "not_detected": "nothing was found in it",
    "full_mask": "all of it was found to be the object",
    "failed": "the model failed on it",
}

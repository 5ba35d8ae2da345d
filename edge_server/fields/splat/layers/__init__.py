"""Fixed cameras in layers: plates, a static field that learns from them, and a moving set over them."""

"""Whatever composes camera node, emulator and edge: virtual deployments, benches, studies, training.
Nothing live imports it."""

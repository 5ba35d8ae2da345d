"""The emulator on the wall clock: a gRPC proxy, and our frame stream as its hook."""

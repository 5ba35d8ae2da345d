"""The emulator on the wall clock: gRPC proxies, timers, traces."""

"""The emulator on the wall clock: a gRPC proxy for any service, and one of freshfield's frame stream."""

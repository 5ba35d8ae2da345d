"""The emulator on the wall clock: a gRPC proxy for any service, with freshfield's frame stream as its
hook."""

"""The splat stream, for browsers that draw Gaussians themselves: records, messages, and the choice of what to send.

docs/splat-stream.md specifies the messages.
"""

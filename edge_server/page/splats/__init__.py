"""Gaussians for the visitor's browser, which draws them itself: records, messages, and what each visitor is sent.

docs/splat-stream.md specifies the messages.
"""

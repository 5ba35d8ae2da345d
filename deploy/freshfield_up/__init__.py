"""The command ``freshfield-up``: starts and supervises every process of a scenario on one machine.

``console`` holds the entry points of all commands.
"""

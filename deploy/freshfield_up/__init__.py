"""The command ``freshfield``. Its ``demo`` starts and supervises every process of a scenario on one machine.

``console`` holds the entry points of all commands.
"""

"""The wire between a taxel board and its host: messages and codecs, with no I/O, clock or thread.

``PROTOCOL.md`` beside this file is normative.
"""

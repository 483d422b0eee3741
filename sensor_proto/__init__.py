"""Wire protocol between taxel boards and their host: messages and codecs. No I/O, clock or threads.

``PROTOCOL.md`` beside this file is normative.
"""

"""Helpers shared by several test folders.

Import as ``from tests.support.waiting import wait_until``.
"""

"""Stands between a stranger's policy file and the machine: the content is read and measured before anything is
loaded, and a program that it carries runs in a process of its own.
"""

"""What stands between a policy file from a stranger and the machine: its content is read and measured before anything is
loaded, and a program that it carries runs in a process of its own.
"""

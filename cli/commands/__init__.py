"""The commands, by what they are for; each parses and calls one function of the module beside this package."""

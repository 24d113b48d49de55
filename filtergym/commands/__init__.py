"""The commands: options in, tables and files out; the rooms do the work."""

"""The commands: options in, tables and files out; what they do stands in the rooms."""

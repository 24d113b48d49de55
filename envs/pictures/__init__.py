"""What is drawn of an environment: one module for each, named like its task; see :mod:`..rendering`."""

"""Gymnasium's interface to a task: environment and vector environment, reset options, mixed scenarios, specifications.

Imports the contract, the drawing and the engine. Begin with :mod:`.environment`, one episode at a time, and
:mod:`.vector_environment`, many; :mod:`.fleet` spreads their lanes over the tasks of a mixture.
"""

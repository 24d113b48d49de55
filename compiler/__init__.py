"""Small compiler for functions of arrays: it traces a function once and runs it as vectorised machine code.

A function written for NumPy or torch through the array API standard does the same arithmetic for each of N
independent lanes (entries of the last axis of all its arrays). On small arrays nearly all the time is spent
in calls of the array library. A run on symbols (:mod:`.namespace`) records the arithmetic of one lane as a
straight line without branches (:mod:`.program`), which is emitted as LLVM code for a block of lanes at a time
(:mod:`.emission`), if long as loops over its array operations (:mod:`.rolling`, :mod:`.loop_emission`). The
code is translated for the current processor and cached for later processes (:mod:`.native`, :mod:`.cache`).
Exponentials and similar functions come from a vector library that is chosen at run time (:mod:`.library`).

The compiler is independent of the purpose of the functions. A function that cannot be traced (a branch that depends on
the numbers, a function that the namespace lacks) raises :class:`~.namespace.NotTraceable`.

Intended differences from NumPy: an expression that is zero for every finite number is zero for other numbers, too (a
product with a constant zero, zero divided by an expression, the difference of an expression and itself); the sign of a
zero may differ; NaN spreads through ``sort``; library functions may differ in their last bits. Results are the same for
every number of lanes and of threads; between processors, and between libraries, they differ in last bits.
"""

"""A small compiler for functions of arrays: trace once, fold, emit vector code, keep it.

What it is for: a function written for NumPy or torch through the array API standard does the same arithmetic for
each of N independent lanes, the last axis of all its arrays. On small arrays nearly all the time goes into calling
the array library. Run once on symbols (:mod:`.namespace`), the function leaves the arithmetic of one lane behind, a
straight line without branches (:mod:`.program`). It is emitted as LLVM code that takes a block of lanes at a time
(:mod:`.emission`), where it is long in loops over its array operations (:mod:`.rolling`, :mod:`.loop_emission`),
translated to the processor at hand and kept for the next process (:mod:`.native`, :mod:`.cache`). Exponentials and
their like come from a vector library that is chosen at run time (:mod:`.library`).

Nothing here knows what the functions compute. What cannot be traced (a branch that depends on the numbers, a function
that the namespace lacks) raises :class:`~.namespace.NotTraceable`.

Differences from NumPy that are wanted: what is zero for every finite number is zero, also of what is not finite (a
product with a constant zero, zero divided by anything, a difference of the same thing); the sign of a zero may differ;
NaN spreads through ``sort``; library functions may differ in their last bits. Results are the same for every number of
lanes and of threads; between processors, and between libraries, they differ in last bits.
"""

"""Attack on the package: hostile inputs by class and seed, each judged by a truth of its own.

``make attack``, or ``python -m attack --inputs 6000 --seed 1`` with tests/ on the path, prints a
table of class by outcome and the inputs that ended badly; ``--only class:seed`` repeats one. The
truth comes from `attack.scenes`, which shares no code with the package.
"""

"""Weights by the examples that landmarks of expressions are: the paper's three solvers behind one interface."""

"""Files of every kind: whole files within a budget, small documents, module states, learned models."""

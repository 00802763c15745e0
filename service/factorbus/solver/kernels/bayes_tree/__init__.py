"""One step of the mode "bayes-tree" in numbered parts: `step` calls them in their order."""

"""The mode "bayes-tree": the memory of the tree, and the steps made with it."""

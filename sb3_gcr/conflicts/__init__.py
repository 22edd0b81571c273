"""Which terms of a reward really conflict: products of gradients without their shared noise."""

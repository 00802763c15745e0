"""Variables and factors as they come in: admission, first values, observability, the block pattern of Λ."""

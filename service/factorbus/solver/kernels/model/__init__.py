"""Variables, factors and losses as mathematics: residuals, Jacobians, ⊞ and χ², one factor at a time."""

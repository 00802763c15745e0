"""Maps that are driven in for years: redundant poses go, so that the size follows the area.  MATH §11.6."""

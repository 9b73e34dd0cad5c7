"""The way of a ray: interval, strata, samples, queries of the field, quadrature."""

"""A recording, made and opened again.

`record` lets `fetching` bring frames and readings, and `writing` puts them on a `tape`, whose
`contents` are named once. A `capture` is what one recording opens as, a `sweep` several of them.
"""

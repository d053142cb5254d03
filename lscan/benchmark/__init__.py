"""Methods judged by pictures whose truth is known: ``lscan bench``, ``lscan bench --suite``.

``drawn`` draws lines and boards; ``methods`` measures every extractor and every plane map by them,
``run`` lays out table and picture.  ``judging`` judges by the cases of a suite, ``suiterun`` runs
that and compares two runs.
"""

"""Results as pages that stand alone: the report of a benchmark and of advice, as HTML, with the outcome in sentences.

Knows ``tables``. Begin with :mod:`.html_report`; :mod:`.html_page` is what every page is written into.
"""

"""Results as self-contained HTML pages: the report of a benchmark and of advice, with the outcome in sentences.

It imports ``tables``. Begin with :mod:`.html_report`; :mod:`.html_page` writes every page.
"""

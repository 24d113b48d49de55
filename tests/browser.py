"""A real browser for pages, where one is installed: Chromium or Chrome without a screen, and its driver."""

import os
import shutil
import tempfile
from contextlib import contextmanager

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def missing():
    """What is missing for tests in a browser, in words; empty if nothing is."""
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium is not installed"
    if not any(map(shutil.which, BROWSERS)):
        return f"no browser is installed: {', '.join(BROWSERS)}"
    return "" if shutil.which("chromedriver") else "chromedriver is not installed"


@contextmanager
def opened(page, width, dark=False, height=900):
    """Open a file in a window of a width, and close the browser at the end."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.binary_location = next(filter(None, map(shutil.which, BROWSERS)))
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    # The browser leaves folders of its own in the temporary one.
    folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
    service = webdriver.ChromeService(shutil.which("chromedriver"), env={**os.environ, "TMPDIR": folder.name})
    driver = webdriver.Chrome(options, service)
    try:
        # A window itself cannot be as narrow as a telephone.
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 700}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        emulate_scheme(driver, dark)
        driver.get(page.as_uri())
        yield driver
    finally:
        driver.quit()
        folder.cleanup()


def emulate_scheme(driver, dark):
    """Let the system that the browser runs on prefer light or dark."""
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})


if __name__ == "__main__":
    print(f"tests in a browser are skipped: {missing()}" if missing() else "tests in a browser run")

"""A study's log as one page that needs nothing but a browser; needs the extra `plots`."""

from casadi_ik.views.report.page import study_page

__all__ = ["study_page"]

"""One roof and its search: height, slopes and the class of every edge."""

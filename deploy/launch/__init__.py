"""What `deploy/up.py` is made of: it starts every process of one scenario on one machine and watches them."""

"""The command ``freshfield-up``: starts every process of one scenario on one machine and watches them."""

"""The methods of Qiu & Kermani 2021."""

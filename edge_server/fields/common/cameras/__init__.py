"""What is learned of cameras while a field trains: appearances, and corrections of poses."""

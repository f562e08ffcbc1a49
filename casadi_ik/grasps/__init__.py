"""What is to be touched: contacts, grasps and objects, numpy only."""

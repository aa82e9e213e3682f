"""Read a legged robot's build off its model: limbs, feet, body plan, roles of joints."""

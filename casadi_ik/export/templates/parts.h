/* Declarations shared by the files of this solver; programs include @PREFIX@.h only. */
#ifndef @GUARD@_PARTS_H
#define @GUARD@_PARTS_H

@MATHS@
#include <stdint.h>
#include <string.h>

#include "@PREFIX@.h"

typedef @REAL@ scalar;

@JOBS@
@PARTS@
@TABLES@

#endif

/* What the files of this solver share; programs include @PREFIX@.h only. */
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
